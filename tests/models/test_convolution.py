"""Weight gradients on CPU are those of the library, however they are transformed, and absent elsewhere."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import run_python
from jax import export, lax

from fcos_lidar_jax.models import convolution
from fcos_lidar_jax.models.convolution import convolve, pointwise

CASES = {
    "3x3": ((3, 3, 6, 5), {}),
    "3x5": ((3, 5, 3, 4), {}),
    "dilated": ((3, 3, 4, 7), {"dilation": 3}),
    "circular": ((3, 3, 4, 5), {"dilation": 2, "circular": True}),
    "strided": ((3, 3, 4, 5), {"stride": 2}),
    "1x1": ((1, 1, 7, 5), {}),
    "1x1 strided": ((1, 1, 5, 7), {"stride": 2}),
}
TOLERANCES = {"float32": 1e-5, "bfloat16": 1e-2}


@pytest.fixture(autouse=True)
def _every_image_is_large(monkeypatch):
    monkeypatch.setattr(convolution, "LARGE", 0)


def library(x, kernel, stride=1, dilation=1, circular=False):
    """The library's convolution of the image padded beforehand."""
    high, wide = (size // 2 * dilation for size in kernel.shape[:2])
    x = jnp.pad(x, ((0, 0), (0, 0), (wide, wide), (0, 0)), mode="wrap" if circular else "constant")
    x = jnp.pad(x, ((0, 0), (high, high), (0, 0), (0, 0)))
    layout = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(
        x, kernel, (stride, stride), "VALID", rhs_dilation=(dilation, dilation), dimension_numbers=layout
    )


def gradients(function):
    """Of a weighted sum over the results: the weights that make them are an argument."""
    return jax.grad(lambda x, kernel, weights: (function(x, kernel) * weights).sum(), argnums=(0, 1))


def example(case: str, dtype: str = "float32", batch: int = 3):
    """Image of odd sizes, kernel, weights of the results, and the expected results and gradients."""
    shape, options = CASES[case]
    rng = np.random.default_rng(0)
    x, kernel = (jnp.asarray(rng.normal(size=size), dtype) for size in ((batch, 9, 13, shape[2]), shape))
    full = [leaf.astype(jnp.float32) for leaf in (x, kernel)]
    values = library(*full, **options)
    weights = jnp.asarray(rng.normal(size=values.shape), dtype)
    expected = gradients(functools.partial(library, **options))(*full, weights.astype(jnp.float32))
    return functools.partial(convolve, **options), (x, kernel, weights), values, expected


def assert_close(found, expected, tolerance):
    for a, b in zip(found, expected, strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())


@pytest.mark.parametrize(
    ("case", "dtype"),
    [*((case, "float32") for case in CASES), *((case, "bfloat16") for case in ("circular", "1x1"))],
)
def test_values_and_gradients_are_the_librarys(case, dtype):
    function, (x, kernel, weights), values, expected = example(case, dtype)
    found = jax.jit(gradients(function))(x, kernel, weights)
    assert [leaf.dtype for leaf in found] == [dtype, dtype]
    assert_close([function(x, kernel), *found], [values, *expected], TOLERANCES[dtype])


@pytest.mark.parametrize("case", ["circular", "1x1"])
def test_batches_of_gradients_and_gradients_of_batches(case):
    """Per-sample gradients add up to the batch's; so does the gradient of a mapped function, recomputed or not."""
    function, (x, kernel, weights), _, (to_x, to_kernel) = example(case)
    one = jax.vmap(gradients(function), (0, None, 0))
    found_x, found_kernel = jax.jit(one)(x[:, None], kernel, weights[:, None])
    assert_close([found_x[:, 0], found_kernel.sum(0)], [to_x, to_kernel], 1e-5)
    mapped = gradients(jax.vmap(jax.checkpoint(function), (0, None)))
    found_x, found_kernel = jax.jit(mapped)(x[:, None], kernel, weights[:, None])
    assert_close([found_x[:, 0], found_kernel], [to_x, to_kernel], 1e-5)


@pytest.mark.parametrize(
    ("size", "dilation", "circular", "dtype"),
    [((3, 3), 3, False, "float32"), ((3, 3), 2, True, "bfloat16"), ((5, 3), 3, True, "float32")],
)
def test_weight_gradients_by_phases_are_the_librarys(size, circular, dilation, dtype):
    """Of sizes that the dilation divides and does not divide, as a GPU computes them."""
    rng = np.random.default_rng(0)
    high, wide = (k // 2 * dilation for k in size)
    for height, width in ((9, 13), (12, 9), (1, 20)):
        shapes = (2, height, width, 6), (*size, 6, 9)
        x, kernel = (jnp.asarray(rng.normal(size=shape), dtype) for shape in shapes)
        x = jnp.pad(x, ((0, 0), (0, 0), (wide, wide), (0, 0)), mode="wrap") if circular else x
        padding = (high, 0 if circular else wide)
        product = functools.partial(
            lax.conv_general_dilated,
            window_strides=(1, 1),
            padding=[(p, p) for p in padding],
            rhs_dilation=(dilation, dilation),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )
        value, pull_back = jax.vjp(product, x, kernel)
        g = jnp.asarray(rng.normal(size=value.shape), dtype)
        options = {"dilation": dilation, "padding": padding, "precision": None}
        found, expected = convolution._by_phases(x, g, sizes=size, **options), pull_back(g)[1]
        assert found.dtype == expected.dtype
        assert_close([found], [expected], TOLERANCES[dtype])


def test_on_a_gpu_no_kernel_is_as_large_as_the_image(monkeypatch):
    """The library's weight gradient of a dilated convolution has the image for a kernel, and a stride."""
    function, arguments, *_ = example("dilated")

    def has_stride(platform):
        program = export.export(jax.jit(lambda *given: gradients(function)(*given)), platforms=(platform,))
        return "stride = [3, 3]" in program(*arguments).mlir_module()

    assert not has_stride("cuda")
    monkeypatch.setattr(convolution, "LARGE", math.inf)  # Small images are the library's on a CPU.
    assert has_stride("cpu")
    assert not has_stride("cuda")


@pytest.mark.parametrize("stride", [1, 2])
def test_a_gpu_has_no_matrix_product_of_pixels(stride):
    """XLA aborts on some of them there, see :func:`convolution.pointwise`; a CPU has nothing else."""
    function, arguments, *_ = example("1x1 strided" if stride == 2 else "1x1")
    products = {}
    for platform in ("cpu", "cuda"):
        text = export.export(jax.jit(gradients(function)), platforms=(platform,))(*arguments).mlir_module()
        products[platform] = "stablehlo.dot_general" in text, "stablehlo.convolution" in text
    assert products == {"cpu": (True, False), "cuda": (False, True)}


@pytest.mark.parametrize("dtype", TOLERANCES)
def test_pointwise_sums_in_the_type_asked_for(dtype):
    _, (x, kernel, weights), values, (to_x, to_kernel) = example("1x1", dtype)
    wide = functools.partial(convolution.pointwise, dtype=jnp.float32)
    assert wide(x, kernel[0, 0]).dtype == jnp.float32
    found = jax.jit(gradients(wide))(x, kernel[0, 0], weights.astype(jnp.float32))
    assert_close([wide(x, kernel[0, 0]), *found], [values, to_x, to_kernel[0, 0]], TOLERANCES[dtype])


def test_pointwise_takes_a_symbolic_number_of_pixels():
    (number,) = export.symbolic_shape("n")
    shapes = jax.ShapeDtypeStruct((1, number, 1, 4), jnp.float32), jax.ShapeDtypeStruct((4, 20), jnp.float32)
    assert export.export(jax.jit(pointwise))(*shapes).out_avals[0].shape == (1, number, 1, 20)


def test_only_cpu_has_rows_also_in_exported_programs():
    function, arguments, _, expected = example("3x3")
    platforms = [("cpu",), ("cuda",), ("tpu",), ("cpu", "cuda")]
    programs = {p: export.export(jax.jit(gradients(function)), platforms=p)(*arguments) for p in platforms}
    loops = {p: program.mlir_module().count("stablehlo.while") for p, program in programs.items()}
    assert loops == {("cpu",): 1, ("cuda",): 0, ("tpu",): 0, ("cpu", "cuda"): 1}
    assert_close(programs["cpu", "cuda"].call(*arguments), expected, 1e-5)


def test_small_images_have_no_rows(monkeypatch):
    function, arguments, *_ = example("3x3")
    work = 9 * 13 * 3 * 3 * 6 * 5 / convolution.LOOP
    for large, loops in ((work, 1), (work + 1, 0)):
        monkeypatch.setattr(convolution, "LARGE", large)
        program = jax.jit(lambda *given: gradients(function)(*given)).lower(*arguments)
        assert program.as_text().count("stablehlo.while") == loops


SHARDED = """
import jax, re
from jax.sharding import NamedSharding, PartitionSpec
from fcos_lidar_jax.devices.mesh import make_mesh, replicate, shard_batch
from test_convolution import TOLERANCES, assert_close, convolution, example, gradients
convolution.LARGE = 0
mesh = make_mesh()
assert mesh.size == 2
for case in ("circular", "1x1"):
    function, (x, kernel, weights), _, expected = example(case, batch=4)
    places = NamedSharding(mesh, PartitionSpec("data")), NamedSharding(mesh, PartitionSpec())
    gradient = jax.jit(gradients(function), out_shardings=places)
    arguments = shard_batch(x, mesh), replicate(kernel, mesh), shard_batch(weights, mesh)
    assert_close(gradient(*arguments), expected, TOLERANCES["float32"])
    text = gradient.lower(*arguments).compile().as_text()
    # The sums over samples are exchanged, once, and no image.
    assert "all-gather" not in text and "all-to-all" not in text, case
    assert len(re.findall(r" all-reduce(?:-start)?[(]", text)) == 1, case
    assert not re.search(r"all-reduce.*while/body", text), case
"""


@pytest.mark.slow
def test_two_devices_exchange_only_the_sums():
    done = run_python("-c", "import sys; sys.path.insert(0, 'tests/models')\n" + SHARDED, JAX_NUM_CPU_DEVICES="2")
    assert done.returncode == 0, done.stderr
