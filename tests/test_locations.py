"""Compare locations with loops over levels, rows and columns."""

import jax.numpy as jnp
import numpy as np
import pytest

from fcos_lidar_jax.config import ModelConfig
from fcos_lidar_jax.locations import STRIDES, ImageLayout, image_layout, locate, location_cells, pad_image
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, sector
from fcos_lidar_jax.types import RangeImage

LAYOUTS = [
    ImageLayout(16, 256, 2),
    ImageLayout(32, 1086, 2),
    ImageLayout(10, 70, 3),
    ImageLayout(16, 70, 1, full_turn=False),
    ImageLayout(16, 10, 1),
]


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_the_pixel_of_a_location_is_its_index_times_the_stride(layout):
    cells = location_cells(layout)
    first = 0
    for stride, size in zip(STRIDES, layout.level_sizes, strict=True):
        width = layout.width // stride
        for l in range(0, size, max(1, size // 50)):
            row, column = (l // width) * stride, (l % width) * stride
            inside = row < layout.rows * layout.row_upscale and column < layout.columns
            expected = row // layout.row_upscale * layout.columns + column if inside else -1
            assert cells[first + l] == expected
        first += size
    assert first == len(cells) == layout.num_locations


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_padding_repeats_rows_and_copies_the_first_columns_of_a_turn(layout):
    image = np.random.default_rng(0).random((1, layout.rows, layout.columns, 9, 2), np.float32)
    padded = np.asarray(pad_image(jnp.asarray(image), layout))
    assert padded.shape == (1, layout.height, layout.width, 9, 2)
    assert layout.height % 32 == layout.width % 32 == 0
    row, column = np.arange(layout.height), np.arange(layout.width)
    source = np.minimum(row // layout.row_upscale, layout.rows - 1)
    expected = image[0][source][:, column % layout.columns]
    expected[row >= layout.rows * layout.row_upscale] = 0
    if not layout.full_turn:
        expected[:, layout.columns :] = 0
    np.testing.assert_array_equal(padded[0], expected)


def test_locations_use_the_first_round_and_padding_is_empty():
    layout = ImageLayout(16, 250, 2)
    rng = np.random.default_rng(1)
    features = rng.random((16, 250, 9, 2), np.float32)
    features[:, :, 7] = rng.random((16, 250, 2)) < 0.6
    features *= features[:, :, 7:8]
    image = RangeImage(jnp.asarray(features), jnp.zeros((16, 250, 2), jnp.int32), jnp.int32(0))
    seen = locate(image, layout)
    cells = location_cells(layout)
    expected = np.where((cells >= 0)[:, None], features[..., 0].reshape(-1, 9)[cells], 0)
    np.testing.assert_array_equal(seen.points, expected[:, :3])
    np.testing.assert_array_equal(seen.azimuth_rad, expected[:, 4])
    np.testing.assert_array_equal(seen.occupied, expected[:, 7] > 0)
    assert (cells < 0).any()


def test_circular_width_gives_whole_strides_without_padding():
    layout = image_layout(NUSCENES_HDL32E, ModelConfig(circular_width=True))
    assert layout.columns == layout.width == 1088
    assert (location_cells(layout) >= 0).all()


def test_a_sector_does_not_wrap():
    part = sector(NUSCENES_HDL32E, np.pi / 2, 272)
    layout = image_layout(part, ModelConfig())
    assert (layout.columns, layout.width, layout.full_turn) == (272, 288, False)
    with pytest.raises(ValueError, match="circular_width: got True for sensor 'nuscenes_hdl32e_272"):
        image_layout(part, ModelConfig(circular_width=True))
