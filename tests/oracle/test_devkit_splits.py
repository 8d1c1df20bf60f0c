"""The official splits hold the scenes that the official devkit lists, in its order."""

import pytest

from fcos_lidar_jax.data.nuscenes.splits import official_splits

devkit = pytest.importorskip("nuscenes.utils.splits", reason="the official devkit is not installed")


def test_official_splits_equal_the_devkits():
    splits = official_splits()
    assert list(splits) == ["train", "val", "test", "mini_train", "mini_val"]
    assert splits == {name: getattr(devkit, name) for name in splits}
