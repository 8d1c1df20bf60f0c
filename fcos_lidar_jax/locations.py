"""Locations of the feature levels: the padded image, and the pixel and 3D point of each location.

Rows are repeated. The pixel of a location is its index times the stride of its level, and its 3D point is the
first-round point at that pixel (paper, sections 3.4 and 4).
"""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32

from fcos_lidar_jax.config import ModelConfig
from fcos_lidar_jax.sensors import Sensor
from fcos_lidar_jax.types import Locations, RangeImage

STRIDES = (1, 2, 4, 8, 16, 32)  # Strides of P2 to P7 in the padded image.


@dataclasses.dataclass(frozen=True)
class ImageLayout:
    """Sizes of the network's input image.

    >>> layout = ImageLayout(rows=32, columns=1086, row_upscale=2)
    >>> layout.height, layout.width, layout.level_sizes[0]
    (64, 1088, 69632)
    """

    rows: int  # Rows of the sensor's image.
    columns: int  # Columns of the sensor's image.
    row_upscale: int  # Row i of the network's image is row ``i // row_upscale`` of the sensor's image.
    full_turn: bool = True
    """True where the first column follows the last. Copies of the first columns then pad the image; otherwise
    empty columns do."""

    @property
    def height(self) -> int:
        """Rows of the network's image, padded with empty rows to a multiple of 32."""
        return _up_to_stride(self.rows * self.row_upscale)

    @property
    def width(self) -> int:
        """Columns of the network's image, padded on the right to a multiple of 32."""
        return _up_to_stride(self.columns)

    @property
    def level_sizes(self) -> tuple[int, ...]:
        """Number of locations per level."""
        return tuple((self.height // s) * (self.width // s) for s in STRIDES)

    @property
    def num_locations(self) -> int:
        """Number of locations in all levels."""
        return sum(self.level_sizes)


def _up_to_stride(size: int) -> int:
    return -(-size // STRIDES[-1]) * STRIDES[-1]


def image_sensor(sensor: Sensor, model: ModelConfig) -> Sensor:
    """Sensor with the image columns of a model: divisible by the largest stride under ``circular_width``.

    Raises:
        ValueError: ``circular_width`` for a sensor that covers only part of the turn.

    >>> from fcos_lidar_jax.sensors import NUSCENES_HDL32E
    >>> image_sensor(NUSCENES_HDL32E, ModelConfig(circular_width=True)).num_columns
    1088
    """
    if not model.circular_width:
        return sensor
    if not sensor.is_full_turn:
        raise ValueError(f"circular_width: got True for sensor {sensor.name!r}, which covers part of a turn")
    return dataclasses.replace(sensor, num_columns=_up_to_stride(sensor.num_columns))


def image_layout(sensor: Sensor, model: ModelConfig) -> ImageLayout:
    """Sizes of the image for a sensor and a model.

    >>> from fcos_lidar_jax.sensors import NUSCENES_HDL32E
    >>> layout = image_layout(NUSCENES_HDL32E, ModelConfig())
    >>> layout.height, layout.width, layout.num_locations
    (64, 1088, 92820)
    """
    binned = image_sensor(sensor, model)
    return ImageLayout(binned.num_rows, binned.num_columns, model.row_upscale, sensor.is_full_turn)


def pad_image(features: Float32[Array, "*b h w c r"], layout: ImageLayout) -> Float32[Array, "*b i j c r"]:
    """Repeat the rows and pad the image to the network's size.

    >>> pad_image(jnp.ones((1, 16, 250, 9, 2)), ImageLayout(16, 250, 2)).shape
    (1, 32, 256, 9, 2)
    """
    image = jnp.repeat(features, layout.row_upscale, axis=-4)
    extra = layout.width - layout.columns
    below = [(0, 0)] * image.ndim
    if layout.full_turn:
        whole, rest = divmod(layout.width, layout.columns)
        image = jnp.concatenate([image] * whole + [image[..., :rest, :, :]], axis=-3) if extra else image
    else:
        below[-3] = (0, extra)
    below[-4] = (0, layout.height - layout.rows * layout.row_upscale)
    return jnp.pad(image, below)


@functools.cache
def location_cells(layout: ImageLayout) -> np.ndarray:
    """Row-major cell of the sensor's image at each location, i32[l]; -1 in a padding row or column.

    >>> location_cells(ImageLayout(16, 256, 2))[:3].tolist()
    [0, 1, 2]
    """
    row, column = np.arange(layout.height) // layout.row_upscale, np.arange(layout.width)
    inside = (row < layout.rows)[:, None] & (column < layout.columns)
    cells = np.where(inside, row[:, None] * layout.columns + column, -1).astype(np.int32)
    return np.concatenate([cells[::s, ::s].ravel() for s in STRIDES])


def locate(image: RangeImage, layout: ImageLayout) -> Locations:
    """Point, azimuth and cell of each location of one sample.

    >>> image = RangeImage(jnp.zeros((16, 256, 9, 1)), jnp.full((16, 256, 1), -1), jnp.int32(0))
    >>> int(locate(image, ImageLayout(16, 256, 2)).occupied.sum())
    0
    """
    cells = location_cells(layout)
    first_round = image.features[..., 0].reshape(layout.rows * layout.columns, -1)
    pixel = jnp.where((cells >= 0)[:, None], first_round[np.maximum(cells, 0)], 0.0)
    return Locations(pixel[:, :3], azimuth_rad=pixel[:, 4], cell=jnp.asarray(cells), occupied=pixel[:, 7] > 0)
