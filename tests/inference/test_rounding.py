"""Effect of the default precision of GPUs and TPUs on predicted boxes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.models import heads
from fcos_lidar_jax.simulation.frame_set import unseen_frames

pytestmark = pytest.mark.slow


def rounded(x, bits):
    """The nearest float32 with this number of fraction bits, at most 23, ties to even."""
    word, cut = jax.lax.bitcast_convert_type(x, jnp.uint32), jnp.uint32(23 - bits)
    near = word + ((word >> cut) & 1) + (jnp.uint32(1) << cut >> 1) - 1
    return jnp.where(cut > 0, jax.lax.bitcast_convert_type(near >> cut << cut, jnp.float32), x)


@pytest.fixture(scope="module")
def predict():
    """Predictions of the shipped detector in an image, with heads rounded to a number of bits; compiled once."""
    trained, convolve = load_trained("hdl32e"), heads.convolve
    stages, frame = make_stages(trained.model), unseen_frames(trained.sensor, 1).frame(0)
    cloud = make_cloud(frame.points, trained.config, sensor=trained.sensor)
    image = stages.prepare(cloud.points, cloud.valid)

    @jax.jit
    def network(bits, variables, image):
        def rough(x, kernel, **how):
            return convolve(rounded(x, bits), rounded(kernel, bits), **how)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(heads, "convolve", rough)
            return stages.network(variables, image)

    return trained.config.inference.min_probability, lambda bits: network(bits, trained.variables, image)


@pytest.mark.parametrize(("bits", "largest_mm"), [(10, 2.0), (7, 16.0)], ids=["TF32", "bfloat16"])
def test_rounding_in_the_heads_moves_centres_by_millimetres(bits, largest_mm, predict):
    """Emulates the default rounding of GPUs (TF32) and TPUs (bfloat16); with ``pytest -s``, prints the effect."""
    threshold, network = predict
    exact, rough = network(23), network(bits)
    probability, other = (np.asarray(jax.nn.softmax(outputs.logits))[:, :-1] for outputs in (exact, rough))
    place, label = np.nonzero(probability > threshold)
    moved_mm = 1e3 * np.abs(exact.regression - rough.regression)[place, :3, label].max()
    change = np.abs(probability - other).max()
    print(f"{len(place)} predictions: centres move by at most {moved_mm:.2f} mm, probabilities by {change:.5f}")
    assert len(place) > 300
    assert 0 < moved_mm < largest_mm
    assert change < largest_mm / 1000
