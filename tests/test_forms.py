"""One form of a function is computed: the one asked for, or the platform's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from fcos_lidar_jax.forms import in_form, search

FORMS = {"sine": jnp.sin, "cosine": jnp.cos}


@pytest.mark.parametrize("form", FORMS)
def test_the_form_that_is_asked_for_is_computed(form):
    x = jnp.linspace(0, 1, 5)
    found = jax.jit(lambda x: in_form(form, FORMS, x, default="sine"))(x)
    assert jnp.allclose(found, FORMS[form](x))


def test_else_it_is_the_platforms_also_in_exported_programs():
    program = jax.jit(lambda x: in_form(None, FORMS, x, cpu="sine", default="cosine"))
    for platform, name in (("cpu", "sine"), ("cuda", "cosine"), ("tpu", "cosine")):
        text = export.export(program, platforms=(platform,))(jnp.ones(3)).mlir_module()
        assert [form for form in FORMS if f"stablehlo.{form}" in text] == [name]


def test_unknown_forms_are_refused_by_name():
    with pytest.raises(ValueError, match="form: got 'tangent', expected 'sine', 'cosine' or None"):
        in_form("tangent", FORMS, jnp.ones(3), default="sine")


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_search_is_numpys_and_a_loop_on_a_cpu_only(side):
    rng = np.random.default_rng(0)
    ascending, values = np.sort(rng.integers(0, 9, 50)).astype(np.int32), rng.integers(-1, 10, 30).astype(np.int32)
    found = jax.jit(lambda a, v: search(a, v, side=side))
    np.testing.assert_array_equal(found(ascending, values), np.searchsorted(ascending, values, side=side))
    for platform, loops in (("cpu", True), ("cuda", False), ("tpu", False)):
        text = export.export(found, platforms=(platform,))(ascending, values).mlir_module()
        assert ("stablehlo.while" in text) == loops
