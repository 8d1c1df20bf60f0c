"""What ``import fcos_lidar_jax`` offers to ``dir()`` and tab completion."""

import subprocess
import sys

import pytest

import fcos_lidar_jax as fcos


@pytest.mark.slow
def test_the_package_offers_its_modules_and_imports_none_of_them():
    assert {"projection", "iou", "nms", "losses", "inference", "load_detector", "__version__"} <= set(dir(fcos))
    code = (
        "import sys, fcos_lidar_jax as fcos; names = dir(fcos); assert 'jax' not in sys.modules; "
        "print([name for name in names if getattr(fcos, name) is None], fcos.nms.rotated_nms.__name__)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[] rotated_nms\n"
    assert {"draw_bev", "draw_range_image", "write_page"} <= set(dir(fcos.visualization))
    with pytest.raises(AttributeError, match="no attribute 'nmss'"):
        _ = fcos.nmss
