"""What ``import fcos_lidar_jax`` offers to ``dir()`` and tab completion."""

import subprocess
import sys
import textwrap

import pytest

import fcos_lidar_jax as fcos


@pytest.mark.slow
def test_the_package_offers_its_modules_and_imports_only_what_is_used():
    assert {"projection", "iou", "nms", "losses", "inference", "load_detector", "__version__"} <= set(dir(fcos))
    code = """
        import sys, fcos_lidar_jax as fcos
        names = dir(fcos)
        assert "jax" not in sys.modules
        import numpy as np
        none = np.zeros(0, int)
        print(fcos.inference.DetectedBoxes(np.zeros((0, 9)), none, none, ("car",), none, {}, 9.0))
        from fcos_lidar_jax import models, training, inference, projection, nms, losses, augment
        # Only for pictures, the command line and checkpoints.
        assert not {"matplotlib", "tyro", "orbax", "tensorflow", "torch"} & sys.modules.keys()
        assert None not in [getattr(fcos, name) for name in names]
        assert fcos.nms.rotated_nms.__name__ == "rotated_nms"
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True)
    assert {"draw_bev", "draw_range_image", "write_page"} <= set(dir(fcos.visualization))
    with pytest.raises(AttributeError, match="no attribute 'nmss'"):
        _ = fcos.nmss
