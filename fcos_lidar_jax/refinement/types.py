"""Containers of the second look, registered as pytrees."""

import dataclasses

import jax
from jaxtyping import Array, Bool, Float32, Int32

LONGEST_M = 25.0  # Longer sides of boxes count as this long.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Crops:
    """Points of enlarged boxes, at most p of each."""

    points: Float32[Array, "*b m p 5"]
    """x, y, z from the centre of the box (metres; x along the heading, y to the left), intensity (0-255), time lag
    (seconds); zero where invalid."""
    index: Int32[Array, "*b m p"]  # Row of the point in the cloud, -1 in slots without a point.
    count: Int32[Array, "*b m"]  # Number of points in the enlarged box, which may exceed p.

    @property
    def valid(self) -> Bool[Array, "*b m p"]:
        """False for slots without a point."""
        return self.index >= 0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Neighbours:
    """The nearest other boxes of each box."""

    index: Int32[Array, "*b m k"]  # Number of the neighbour among the boxes; arbitrary where invalid.
    valid: Bool[Array, "*b m k"]  # False where there are fewer neighbours.
    features: Float32[Array, "*b m k 10"]  # How the neighbour lies to the box, see ``network.find_neighbours``.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LookInputs:
    """Inputs of the network."""

    points: Float32[Array, "*b m p 14"]  # See ``network.point_features``.
    valid: Bool[Array, "*b m p"]  # False for slots without a point.
    boxes: Float32[Array, "*b m f"]  # See ``network.box_features``.
    neighbours: Neighbours | None  # None if boxes are not compared.


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RefinementTargets:
    """Targets of the boxes of one cloud."""

    label: Int32[Array, "*b m"]  # Class of the object that the box stands for, the number of classes for none.
    residual: Float32[Array, "*b m r"]
    """Residual to the object, see :func:`~fcos_lidar_jax.refinement.targets.encode_residual`; zero unless near.
    NaN velocity where unknown."""
    near: Bool[Array, "*b m"]  # Whether the centre of the object is within its radius.
    weight: Float32[Array, "*b m"]  # Weight of the classification; zero where the box is invalid.
