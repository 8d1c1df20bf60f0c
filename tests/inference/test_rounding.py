"""What the default precision of GPUs and TPUs costs where boxes are predicted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.models import heads
from fcos_lidar_jax.simulation.frame_set import unseen_frames


def rounded(x, bits):
    """To the nearest float32 with so many bits of fraction, half to even."""
    word, cut = jax.lax.bitcast_convert_type(x, jnp.uint32), 23 - bits
    word = word + ((word >> cut) & 1) + jnp.uint32((1 << (cut - 1)) - 1)
    return jax.lax.bitcast_convert_type(word >> cut << cut, jnp.float32)


@pytest.mark.parametrize(("bits", "largest_mm"), [(10, 2.0), (7, 16.0)], ids=["TF32", "bfloat16"])
def test_rounded_inputs_of_the_predictions_move_centres_by_millimetres(bits, largest_mm, monkeypatch):
    """As GPUs (TF32) and TPUs (bfloat16) round them by default; with the shipped weights, where a class is likely.

    ``python -m pytest -s`` on this file prints by how much.
    """
    trained = load_trained("hdl32e")
    stages, frame = make_stages(trained.model), unseen_frames(trained.sensor, 1).frame(0)
    cloud = make_cloud(frame.points, trained.config, sensor=trained.sensor)
    image = jax.jit(stages.prepare)(cloud.points, cloud.valid)
    exact = jax.jit(stages.network)(trained.variables, image)
    convolve = heads.convolve
    monkeypatch.setattr(heads, "convolve", lambda x, k, **how: convolve(rounded(x, bits), rounded(k, bits), **how))
    rough = jax.jit(lambda *given: stages.network(*given))(trained.variables, image)
    probability, other = (np.asarray(jax.nn.softmax(outputs.logits))[:, :-1] for outputs in (exact, rough))
    place, label = np.nonzero(probability > trained.config.inference.min_probability)
    moved = np.abs(exact.regression - rough.regression)[place, :, label]
    print(
        f"{len(place)} pairs: centres move by at most {1e3 * moved[:, :3].max():.2f} mm, "
        f"probabilities by {np.abs(probability - other).max():.5f}"
    )
    assert len(place) > 300
    assert 0 < 1e3 * moved[:, :3].max() < largest_mm
    assert np.abs(probability - other).max() < largest_mm / 1000
