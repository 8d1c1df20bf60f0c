"""``in_form`` computes the requested form, or the form that suits the platform."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from fcos_lidar_jax.forms import in_form, search

FORMS = {"sine": jnp.sin, "cosine": jnp.cos}


@pytest.mark.parametrize("form", FORMS)
def test_the_requested_form_is_computed(form):
    x = jnp.linspace(0, 1, 5)
    actual = jax.jit(lambda x: in_form(form, FORMS, x, default="sine"))(x)
    assert jnp.allclose(actual, FORMS[form](x))


def test_exported_programs_use_the_form_of_their_platform():
    program = jax.jit(lambda x: in_form(None, FORMS, x, cpu="sine", default="cosine"))
    for platform, name in (("cpu", "sine"), ("cuda", "cosine"), ("tpu", "cosine")):
        text = export.export(program, platforms=(platform,))(jnp.ones(3)).mlir_module()
        assert [form for form in FORMS if f"stablehlo.{form}" in text] == [name]


@pytest.mark.parametrize("side", ["left", "right"])
def test_search_matches_numpy_and_loops_only_on_cpus(side):
    rng = np.random.default_rng(0)
    ascending, values = np.sort(rng.integers(0, 9, 50)).astype(np.int32), rng.integers(-1, 10, 30).astype(np.int32)
    actual = jax.jit(lambda a, v: search(a, v, side=side))
    np.testing.assert_array_equal(actual(ascending, values), np.searchsorted(ascending, values, side=side))
    for platform, loops in (("cpu", True), ("cuda", False), ("tpu", False)):
        text = export.export(actual, platforms=(platform,))(ascending, values).mlir_module()
        assert ("stablehlo.while" in text) == loops
