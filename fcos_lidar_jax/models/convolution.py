"""Convolutions, with weight gradients in the form that suits the platform.

XLA's CPU backend is good at values and input gradients, but up to five times slower than matrix products at the
weight gradients of few channels on large images. On other platforms, and for small images, all is the library's.
"""

import functools
from collections.abc import Callable

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
"""For layers that take positions or predict them: by default GPUs and TPUs round float32 to TF32 or bfloat16."""


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
        return pointwise(x[:, ::stride, ::stride], kernel[0, 0], precision=precision)
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
    if stride > 1 or groups > 1:
        return product(x, kernel)
    by_rows = functools.partial(_by_rows, sizes=kernel.shape[:2], dilation=dilation, padding=(high, wide))
    return _linear(product, by_rows, x, kernel, LOOP * LARGE)


def pointwise(
    x: Image,
    kernel: Float[Array, "_ _"],
    *,
    dtype: DTypeLike | None = None,
    precision: lax.Precision | None = None,
) -> Image:
    """A 1x1 convolution as a matrix product, summed in ``dtype``, by default that of ``x``.

    >>> pointwise(jnp.ones((1, 8, 8, 2)), jnp.ones((2, 4)))[0, 0, 0].tolist()
    [2.0, 2.0, 2.0, 2.0]
    """
    kernel = kernel.astype(x.dtype)
    product = functools.partial(_of_pixels, dtype=dtype, precision=precision)
    return _linear(product, _flat, x, kernel, LARGE)


def _of_pixels(x: Image, kernel: Array, dtype: DTypeLike | None, precision: lax.Precision | None) -> Image:
    return jnp.einsum("bhwc,co->bhwo", x, kernel, preferred_element_type=dtype, precision=precision)


def _linear(
    product: Callable[..., Image], on_cpu: Callable[..., Array], x: Image, kernel: Array, least: float
) -> Image:
    """``product(x, kernel)``, whose weight gradient on CPU is ``on_cpu(x, g)`` from ``least`` multiply-adds on."""
    large = x.shape[1] * x.shape[2] * kernel.size >= least
    return _with_weight_gradient(product, on_cpu, x, kernel) if large else product(x, kernel)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _with_weight_gradient(product: Callable, on_cpu: Callable, x: Image, kernel: Array) -> Image:
    return product(x, kernel)


def _forward(product: Callable, on_cpu: Callable, x: Image, kernel: Array) -> tuple[Image, tuple[Image, Array]]:
    return product(x, kernel), (x, kernel)


def _backward(product: Callable, on_cpu: Callable, inputs: tuple[Image, Array], g: Image) -> tuple[Image, Array]:
    x, kernel = inputs

    def library(x: Image, g: Image) -> Array:
        return jax.linear_transpose(lambda kernel: product(x, kernel), kernel)(g)[0]

    def chosen(x: Image, g: Image) -> Array:
        return on_cpu(x, g).astype(kernel.dtype)

    (to_x,) = jax.linear_transpose(lambda x: product(x, kernel), x)(g)
    return to_x, lax.platform_dependent(x, g, cpu=chosen, default=library)


_with_weight_gradient.defvjp(_forward, _backward)


def _flat(x: Image, g: Image) -> Float[Array, "_ _"]:
    """Weight gradient of a 1x1 convolution, one product of all pixels, the wider side on the right."""
    x, g = x.reshape(-1, x.shape[-1]), g.reshape(-1, g.shape[-1])
    product = functools.partial(jnp.einsum, "pa,pb->ab", preferred_element_type=_summed_in(x))
    if x.shape[1] <= g.shape[1]:
        return product(x, g)
    return lax.optimization_barrier(product(g, x)).T  # Without the barrier XLA turns it back: half the speed.


def _summed_in(x: Array) -> DTypeLike:
    return jnp.promote_types(x.dtype, jnp.float32)


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
