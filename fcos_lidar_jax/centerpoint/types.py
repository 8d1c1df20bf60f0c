"""Containers of CenterPoint's input and outputs, one sample or a batch of samples."""

import dataclasses

import jax
from jaxtyping import Array, Float32, Int32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pillars:
    """A point cloud divided into pillars, the input of CenterPoint."""

    features: Float32[Array, "*b n 10"]
    """x, y, z, intensity, time lag, offset from the mean of the pillar's points 3, offset from the pillar's axis
    2; zero for excluded points."""
    cell: Int32[Array, "*b n"]  # Row-major pillar of each point; the number of pillars for excluded points.
    num_dropped: Int32[Array, "*b"]  # Valid input rows that were non-finite or beyond the sensor's limits.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class CentreOutputs:
    """Raw predictions of CenterPoint on the bird's-eye-view map: rows along y, columns along x."""

    heat: Float32[Array, "*b h w k"]  # Logit of an object centre, per class.
    regression: Float32[Array, "*b h w g 10"]
    """Per group of classes: centre offset 3 (x and y in cells, z in metres), log size 3, sin and cos of the yaw,
    velocity 2."""
