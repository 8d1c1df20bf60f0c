"""What ``import fcos_lidar_jax`` and the modules of the core offer to ``dir()`` and tab completion."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import fcos_lidar_jax as fcos

CORE = [name for name in fcos._MODULES if (Path(fcos.__file__).parent / f"{name}.py").is_file()]


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


@pytest.mark.parametrize("name", CORE)
def test_core_modules_offer_only_what_they_define(name):
    module = import_module(f"fcos_lidar_jax.{name}")
    body = ast.parse(Path(module.__file__).read_text()).body
    defined = {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    assigned = {target.id for node in body if isinstance(node, ast.Assign) for target in node.targets}
    assigned |= {node.target.id for node in body if isinstance(node, ast.AnnAssign)}
    public = {name for name in defined | assigned if not name.startswith("_")}
    constants = {name for name in vars(module) if name.isupper()}  # imported ones too
    aliases = {name for name in assigned if not name.isupper()}  # of array types
    assert public
    assert public - aliases <= set(dir(module)) <= public | constants
