"""Convolutions, with weight gradients in the form that suits the platform.

XLA's CPU backend is good at values and input gradients, but up to five times slower than matrix products at the
weight gradients of few channels on large images. On GPUs, XLA turns the weight gradient of a dilated convolution
into a convolution whose kernel is as large as the image, for which cuDNN has no good algorithm: there it is
computed as the weight gradient of an undilated one. Everything else is the library's.
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

Image = Float[Array, "b _ _ _"]  # Height, width and channels change from layer to layer.
Kernel = Float[Array, "_ _ _ _"]

LARGE = 1 << 24
"""Multiply-adds an image from which another form of the weight gradient is worth compiling."""

LOOP = 16
"""How many times as many are needed for a loop over rows, which XLA compiles anew for each layer."""


FULL = lax.Precision.HIGHEST
"""For layers that take positions: by default GPUs and TPUs round float32 inputs to TF32 or bfloat16."""


def convolve(
    x: Image,
    kernel: Kernel,
    *,
    stride: int = 1,
    dilation: int = 1,
    groups: int = 1,
    circular: bool = False,
    precision: lax.Precision | None = None,
) -> Image:
    """Convolution with ``k // 2 * dilation`` zeros on both sides, or wrapped around the width.

    Stride and dilation are those of both axes, ``groups`` is the ``feature_group_count``, the kernel's sizes are
    odd. The result has the type of ``x``. Differentiable in reverse mode.

    >>> convolve(jnp.ones((1, 8, 8, 2)), jnp.ones((3, 3, 2, 4)), stride=2).shape
    (1, 4, 4, 4)
    """
    kernel = kernel.astype(x.dtype)
    high, wide = (size // 2 * dilation for size in kernel.shape[:2])
    if kernel.shape[:2] == (1, 1) and groups == 1:
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
        feature_group_count=groups,
        precision=precision,
    )
    how: dict[str, Any] = {"sizes": kernel.shape[:2], "dilation": dilation, "padding": (high, wide)}
    forms = {}
    if stride == groups == 1 and _multiply_adds(x, kernel) >= LOOP * LARGE:
        forms["cpu"] = functools.partial(_by_rows, **how)
    if stride == 1 and dilation > 1:
        forms["default"] = functools.partial(_by_phases, **how, groups=groups, precision=precision)
    return _with_weight_gradient(product, forms, x, kernel)


def pointwise(
    x: Image,
    kernel: Float[Array, "_ _"],
    *,
    stride: int = 1,
    dtype: DTypeLike | None = None,
    precision: lax.Precision | None = None,
) -> Image:
    """A 1x1 convolution, summed in ``dtype``, by default that of ``x``: on a CPU as a matrix product.

    >>> pointwise(jnp.ones((1, 8, 8, 2)), jnp.ones((2, 4)))[0, 0, 0].tolist()
    [2.0, 2.0, 2.0, 2.0]
    """
    kernel = kernel.astype(x.dtype)
    taken = (x.shape[0], -(-x.shape[1] // stride), -(-x.shape[2] // stride))
    product = functools.partial(_of_pixels, stride=stride, dtype=dtype or x.dtype, precision=precision)
    large = math.prod(taken[1:]) * kernel.size >= LARGE
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

    if dtype != x.dtype:  # The library has no gradient of a convolution of two types.
        return matrix_product(x, kernel)
    # On GPUs XLA fuses matrix products with what is around them, and fails at some: it aborts where there is a
    # stride (triton_tiling_propagation.cc: Check failed) and finds no tiles for others on an A100 (jaxlib 0.10.2).
    return lax.platform_dependent(x, kernel, cpu=matrix_product, default=convolution)


def _multiply_adds(x: Image, kernel: Array) -> int:
    """Of one image, at stride 1."""
    return x.shape[1] * x.shape[2] * kernel.size


def _with_weight_gradient(
    product: Callable[..., Image], forms: dict[str, Callable[..., Array]], x: Image, kernel: Array
) -> Image:
    """``product(x, kernel)``, whose weight gradient is ``forms[platform](x, g)``, else the library's."""
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
    """Weight gradient of a 1x1 convolution, one product of all pixels, the wider side on the right."""
    x = x[:, ::stride, ::stride]
    x, g = x.reshape(-1, x.shape[-1]), g.reshape(-1, g.shape[-1])
    product = functools.partial(jnp.einsum, "pa,pb->ab", preferred_element_type=_summed_in(x))
    if x.shape[1] <= g.shape[1]:
        return product(x, g)
    return lax.optimization_barrier(product(g, x)).T  # Without the barrier XLA turns it back: half the speed.


def _summed_in(x: Array) -> DTypeLike:
    return jnp.promote_types(x.dtype, jnp.float32)


def _by_phases(
    x: Image,
    g: Image,
    *,
    sizes: tuple[int, ...],
    dilation: int,
    padding: tuple[int, int],
    groups: int,
    precision: lax.Precision | None,
) -> Kernel:
    """Weight gradient at stride 1 as that of an undilated convolution.

    Pixels that are ``dilation`` apart become neighbours in one of ``dilation * dilation`` smaller images.
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
        feature_group_count=groups,
        precision=precision,
    )
    kernel = jax.ShapeDtypeStruct((*sizes, x.shape[-1] // groups, g.shape[-1]), x.dtype)
    return jax.linear_transpose(product, kernel)(g)[0]


def _by_rows(x: Image, g: Image, *, sizes: tuple[int, ...], dilation: int, padding: tuple[int, int]) -> Kernel:
    """Weight gradient at stride 1: for each row of the image one product for all taps.

    The wider side is on the right. The samples of a batch are summed last, so that several devices exchange their
    sums once and not in every row.
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
