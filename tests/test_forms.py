"""Functions in several forms take the one that suits the platform; their own tests ask for each form."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from fcos_lidar_jax.assignment import assign, owners
from fcos_lidar_jax.forms import search
from fcos_lidar_jax.nms import merge_boxes


@pytest.mark.parametrize("side", ["left", "right"])
def test_search_matches_numpy(side):
    rng = np.random.default_rng(0)
    ascending, values = np.sort(rng.integers(0, 9, 50)).astype(np.int32), rng.integers(-1, 10, 30).astype(np.int32)
    actual = jax.jit(lambda a, v: search(a, v, side=side))
    np.testing.assert_array_equal(actual(ascending, values), np.searchsorted(ascending, values, side=side))


ROWS, NINE = jnp.zeros(9, jnp.int32), jnp.ones(9)
BOXES, POINTS = (jnp.ones((4, 7)), jnp.ones(4, bool)), (jnp.zeros((9, 3)), jnp.ones(9, bool))
MERGED = (BOXES[0], jnp.ones(4), BOXES[1], jnp.arange(2), jnp.ones(2, bool), jnp.zeros(4, jnp.int32))
LOOPS = {  # a function, its arguments, and the loops of its program for a CPU
    "search left": (functools.partial(search, side="left"), (ROWS, ROWS), 1),
    "search right": (functools.partial(search, side="right"), (ROWS, ROWS), 1),
    "owners": (owners, (*POINTS, *BOXES), 1),
    "assign": (functools.partial(assign, num_boxes=4), (ROWS, NINE, NINE), 1),
    "merge": (lambda *given: merge_boxes(*given[:5], labels=given[5], iou_threshold=0.3), MERGED, 2),
}


@pytest.mark.parametrize("name", LOOPS)
def test_only_programs_of_cpus_loop(name):
    function, given, loops = LOOPS[name]
    for platform, expected in (("cpu", loops), ("cuda", 0), ("tpu", 0)):
        program = export.export(jax.jit(function), platforms=(platform,))(*given)
        assert program.mlir_module().count("stablehlo.while") == expected
