"""Convolutions whose weight gradients suit the platform.

XLA's CPU backend computes values and input gradients well, but for large images with few channels its weight
gradients are up to five times slower than matrix products. On GPUs, XLA turns the weight gradient of a dilated
convolution into a convolution with a kernel as large as the image, for which cuDNN has no good algorithm; here it
is computed as the weight gradient of an undilated convolution.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float

Image = Float[Array, "b _ _ _"]  # Batch, height, width and channels.
Kernel = Float[Array, "_ _ _ _"]

LARGE = 1 << 24
"""Multiply-adds per image above which matrix products are worth compiling for the weight gradient on a CPU."""

LOOP = 16
"""Multiple of ``LARGE`` above which a loop over rows is, which XLA compiles separately for each layer."""

FULL = lax.Precision.HIGHEST
"""Precision of layers whose input contains positions, which GPUs and TPUs would round to TF32 or bfloat16."""


def convolve(
    x: Image,
    kernel: Kernel,
    *,
    stride: int = 1,
    dilation: int = 1,
    circular: bool = False,
    precision: lax.Precision | None = None,
) -> Image:
    """Convolve with ``k // 2 * dilation`` zeros on each side, or with wrap-around along the width.

    Stride and dilation apply to both axes, and kernel sizes are odd. The result has the dtype of ``x``.
    Differentiable in reverse mode.
    """
    kernel = kernel.astype(x.dtype)
    high, wide = (size // 2 * dilation for size in kernel.shape[:2])
    if kernel.shape[:2] == (1, 1):
        return pointwise(x, kernel[0, 0], stride=stride, precision=precision)
    if circular and wide:
        x = jnp.concatenate([x[:, :, -wide:], x, x[:, :, :wide]], axis=2)
        wide = 0
    product = functools.partial(
        lax.conv_general_dilated,
        window_strides=(stride, stride),
        padding=[(high, high), (wide, wide)],
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=precision,
    )
    how: dict[str, Any] = {"sizes": kernel.shape[:2], "dilation": dilation, "padding": (high, wide)}
    forms = {}
    if stride == 1 and x.shape[1] * x.shape[2] * kernel.size >= LOOP * LARGE:  # multiply-adds per image
        forms["cpu"] = functools.partial(_by_rows, **how)
    if stride == 1 and dilation > 1:
        forms["default"] = functools.partial(_by_phases, **how, precision=precision)
    return _with_weight_gradient(product, forms, x, kernel)


def pointwise(
    x: Image,
    kernel: Float[Array, "_ _"],
    *,
    stride: int = 1,
    dtype: DTypeLike | None = None,
    precision: lax.Precision | None = None,
) -> Image:
    """Compute a 1x1 convolution, accumulated in ``dtype`` (default: the dtype of ``x``)."""
    kernel = kernel.astype(x.dtype)
    product = functools.partial(_of_pixels, stride=stride, dtype=dtype or x.dtype, precision=precision)
    num_outputs = math.prod(-(-size // stride) for size in x.shape[1:3])
    large = isinstance(num_outputs, int) and num_outputs * kernel.size >= LARGE  # or symbolic, in an export
    forms = {"cpu": functools.partial(_flat, stride=stride)} if large else {}
    return _with_weight_gradient(product, forms, x, kernel)


def _of_pixels(x: Image, kernel: Array, stride: int, dtype: DTypeLike, precision: lax.Precision | None) -> Image:
    def matrix_product(x: Array, kernel: Array) -> Array:
        x = x[:, ::stride, ::stride]
        return jnp.einsum("bhwc,co->bhwo", x, kernel, preferred_element_type=dtype, precision=precision)

    def convolution(x: Array, kernel: Array) -> Array:
        layout, strides = ("NHWC", "HWIO", "NHWC"), (stride, stride)
        kernel = kernel[None, None]
        return lax.conv_general_dilated(x, kernel, strides, "VALID", dimension_numbers=layout, precision=precision)

    if dtype != x.dtype:  # JAX has no gradient of a convolution with two dtypes.
        return matrix_product(x, kernel)
    # On GPUs, XLA fuses matrix products with neighbouring operations and fails for some: it aborts if there is a
    # stride (triton_tiling_propagation.cc: Check failed) and finds no tiles for others on an A100 (jaxlib 0.10.2).
    return lax.platform_dependent(x, kernel, cpu=matrix_product, default=convolution)


def _with_weight_gradient(
    product: Callable[..., Image], forms: dict[str, Callable[..., Array]], x: Image, kernel: Array
) -> Image:
    """Compute ``product(x, kernel)`` with the weight gradient ``forms[platform](x, g)``, by default JAX's."""
    return _custom(product, tuple(forms.items()), x, kernel) if forms else product(x, kernel)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _custom(product: Callable, forms: tuple, x: Image, kernel: Array) -> Image:
    return product(x, kernel)


def _forward(product: Callable, forms: tuple, x: Image, kernel: Array) -> tuple[Image, tuple[Image, Array]]:
    return product(x, kernel), (x, kernel)


def _backward(product: Callable, forms: tuple, inputs: tuple[Image, Array], g: Image) -> tuple[Image, Array]:
    x, kernel = inputs

    def library(x: Image, g: Image) -> Array:
        return jax.linear_transpose(lambda kernel: product(x, kernel), kernel)(g)[0]

    def converted(form: Callable[..., Array]) -> Callable[..., Array]:
        return lambda x, g: form(x, g).astype(kernel.dtype)

    (to_x,) = jax.linear_transpose(lambda x: product(x, kernel), x)(g)
    by_platform = {"cpu": library, "default": library} | {name: converted(form) for name, form in forms}
    return to_x, lax.platform_dependent(x, g, **by_platform)


_custom.defvjp(_forward, _backward)


def _flat(x: Image, g: Image, *, stride: int) -> Float[Array, "_ _"]:
    """Weight gradient of a 1x1 convolution: one product over all pixels, with the wider operand on the right."""
    x = x[:, ::stride, ::stride]
    x, g = x.reshape(-1, x.shape[-1]), g.reshape(-1, g.shape[-1])
    product = functools.partial(jnp.einsum, "pa,pb->ab", preferred_element_type=_summed_in(x))
    if x.shape[1] <= g.shape[1]:
        return product(x, g)
    return lax.optimization_barrier(product(g, x)).T  # Without the barrier XLA undoes the swap, at half the speed.


def _summed_in(x: Array) -> DTypeLike:
    return jnp.promote_types(x.dtype, jnp.float32)


def _by_phases(
    x: Image,
    g: Image,
    *,
    sizes: tuple[int, ...],
    dilation: int,
    padding: tuple[int, int],
    precision: lax.Precision | None,
) -> Kernel:
    """Weight gradient at stride 1, computed as the weight gradient of an undilated convolution.

    Pixels at a distance of ``dilation`` become neighbours in one of ``dilation * dilation`` smaller images.
    """

    def phases(image: Array) -> Array:
        image = jnp.pad(image, ((0, 0), *((0, -size % dilation) for size in image.shape[1:3]), (0, 0)))
        b, h, w, c = image.shape
        image = image.reshape(b, h // dilation, dilation, w // dilation, dilation, c)
        return image.transpose(0, 2, 4, 1, 3, 5).reshape(-1, h // dilation, w // dilation, c)

    x, g = phases(x), phases(g)
    product = functools.partial(
        lax.conv_general_dilated,
        x,
        window_strides=(1, 1),
        padding=[(size // dilation, size // dilation) for size in padding],
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=precision,
    )
    kernel = jax.ShapeDtypeStruct((*sizes, x.shape[-1], g.shape[-1]), x.dtype)
    return jax.linear_transpose(product, kernel)(g)[0]


def _by_rows(x: Image, g: Image, *, sizes: tuple[int, ...], dilation: int, padding: tuple[int, int]) -> Kernel:
    """Weight gradient at stride 1: one product for all taps per image row, with the wider operand on the right.

    Samples are summed last, so that several devices exchange sums once instead of once per row.
    """
    (rows, columns), (high, wide) = sizes, padding
    (batch, height, _, inputs), (width, outputs) = x.shape, g.shape[2:]
    order = -1 if inputs > outputs else 1
    product = functools.partial(jnp.einsum, "bwi,bwj->bij", preferred_element_type=_summed_in(x))

    def row_of_g(i: Array) -> Array:
        inside = (i >= 0) & (i < height)
        return jnp.where(inside, lax.dynamic_index_in_dim(g, i, 1, keepdims=False), 0)

    def add_row(i: Array, total: Array) -> Array:
        row = jnp.pad(lax.dynamic_index_in_dim(x, i, 1, keepdims=False), ((0, 0), (wide, wide), (0, 0)))
        taken = jnp.stack([row[:, dilation * q :][:, :width] for q in range(columns)], axis=2)
        reached = jnp.stack([row_of_g(i + high - dilation * j) for j in range(rows)], axis=2)
        sides = [taps.reshape(batch, width, -1) for taps in (taken, reached)]
        return total + product(*sides[::order])

    total = jnp.zeros((batch, *(columns * inputs, rows * outputs)[::order]), _summed_in(x))
    total = lax.fori_loop(0, height, add_row, total).sum(0)
    if order < 0:
        return total.reshape(rows, outputs, columns, inputs).transpose(0, 2, 3, 1)
    return total.reshape(columns, inputs, rows, outputs).transpose(2, 0, 1, 3)
