"""Check that a wheel and a source archive hold what they should, and nothing else.

python look_into_wheel.py WHEEL SDIST
"""

import sys
import tarfile
import zipfile
from pathlib import PurePosixPath

NEEDED = (
    "py.typed",
    "weights/quickstart/checkpoint.json",
    "weights/hdl32e/checkpoint.json",
    "weights/hdl32e/README.md",
    "data/nuscenes/splits.toml",
    "simulation/objects.toml",
    "simulation/clutter.toml",
    "visualization/page.html",
)
BESIDE = ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in")  # the package, in the source archive
MADE = ("PKG-INFO", "setup.cfg")  # by the build
KINDS = {".py", ".typed", ".toml", ".html"}  # and whatever Orbax calls its arrays

wheel, source = sys.argv[1:]
names = zipfile.ZipFile(wheel).namelist()
inside = [PurePosixPath(n) for n in names if not n.split("/")[0].endswith(".dist-info")]
if missing := [name for name in NEEDED if f"fcos_lidar_jax/{name}" not in names]:
    sys.exit(f"{wheel}: no {missing[0]} in it")
if not any(name.endswith("LICENSE") for name in names):
    sys.exit(f"{wheel}: no licence in it")
own = [p for p in inside if p.parts[0] == "fcos_lidar_jax" and (p.suffix in KINDS or "weights" in p.parts)]
if strangers := sorted(set(inside) - set(own)):
    sys.exit(f"{wheel}: contains {strangers[0]}, expected only the package")
with tarfile.open(source) as archive:
    packed = [PurePosixPath(*PurePosixPath(m.name).parts[1:]) for m in archive.getmembers() if m.isfile()]
for name in (*BESIDE, *(f"fcos_lidar_jax/{name}" for name in NEEDED)):
    if PurePosixPath(name) not in packed:
        sys.exit(f"{source}: no {name} in it")
known = {*own, *map(PurePosixPath, (*BESIDE, *MADE))}
if strangers := sorted(p for p in packed if p not in known and p.parts[0] != "fcos_lidar_jax.egg-info"):
    sys.exit(f"{source}: holds {strangers[0]}, expected the package and {', '.join(BESIDE)}")
print(f"{wheel}: {len(names)} files; {source}: {len(packed)} files")
