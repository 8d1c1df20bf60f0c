"""Shared set-up: shape checks in signatures, a compilation cache, where the real data are."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook
from matplotlib.figure import Figure
from quick import compile_quickly

# The containers are left out: tree transformations fill their annotated fields with other things. Sensors and
# configurations check themselves, in their own words.
_UNCHECKED = ("types", "sensors", "config", "cli")
_PACKAGE = Path(__file__).parents[1] / "fcos_lidar_jax"
_MODULES = [p.stem for p in _PACKAGE.glob("*.py") if p.stem not in ("__init__", "__main__", *_UNCHECKED)]
_SECOND = [f"centerpoint.{name}" for name in ("pillars", "centres", "network", "objective", "detector")]
_SECOND += [f"refinement.{name}" for name in ("crops", "targets", "network", "stage")]
_ROOMS = ["models", "inference", "evaluation", "checkpoints", "devices", "data.cloud_policy", *_SECOND]
# A run, like a command, checks its numbers in its own words.
_STEP = [
    f"training.{p.stem}" for p in (_PACKAGE / "training").glob("*.py") if p.stem not in ("__init__", "plan", "run")
]
install_import_hook([f"fcos_lidar_jax.{name}" for name in (*_MODULES, *_ROOMS, *_STEP)], "typecheck.check")

# A shell's background job ignores Ctrl-C, what nohup starts a hang-up, and so would the processes that the tests
# start and interrupt.
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, usual)

# XLA rounds differently on another number of cores, which the key of a cached program does not contain.
_CORES = len(os.sched_getaffinity(0))
jax.config.update("jax_compilation_cache_dir", str(_PACKAGE.parent / ".cache" / f"jax-{_CORES}"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # a process compiles hundreds of small programs


# Most of the time goes to compilation, so programs are compiled without optimisation, except where the last bits
# of the optimised program matter: marked ``optimised``.
def _is_quick(item: pytest.Item) -> bool:
    return item.get_closest_marker("optimised") is None


_NETWORKS = ("centerpoint", "checkpoints", "inference", "models", "refinement", "training")


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Examples that compile networks are slow.

    Files with optimised programs come first, for a change of the mode forgets all programs; short doctests come
    last.
    """
    for item in items:
        if isinstance(item, pytest.DoctestItem) and item.path.parent.name in _NETWORKS:
            item.add_marker(pytest.mark.slow)
    optimised = {item.path for item in items if not _is_quick(item)}
    items.sort(key=lambda item: item.path not in optimised)


@pytest.hookimpl(tryfirst=True)  # before fixtures compile anything
def pytest_runtest_setup(item: pytest.Item) -> None:
    compile_quickly(_is_quick(item))


# Where the question is which pictures there are, not how they look, they have a ninth of the pixels and no layout.
_COARSE = ("cli", "experiments", "models", "training")


@pytest.fixture(scope="module", autouse=True)
def _coarse_pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    def coarse(figure: Figure, *args, dpi: float, **options) -> None:
        figure.set_layout_engine("none")
        savefig(figure, *args, dpi=dpi / 3, **options)

    savefig = Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name in _COARSE:
            patch.setattr(Figure, "savefig", coarse)
        yield


@pytest.fixture(autouse=True)
def _nothing_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Notes that are printed once per process are printed in each test."""
    monkeypatch.setattr("fcos_lidar_jax.progress._told", set())


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder with real LiDAR data; the test is skipped where there is none."""
    folder = os.environ.get("FCOS_LIDAR_REAL_DATA")
    if not folder:
        pytest.skip("FCOS_LIDAR_REAL_DATA is not set: no real LiDAR data here")
    return Path(folder)


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set of ``two_scenes``, for tests of several commands."""
    from two_scenes import make_two_scenes  # imports the package, whose signatures are checked from here on

    return make_two_scenes(tmp_path_factory.mktemp("home"))


@pytest.fixture
def linear() -> Iterator[None]:
    """Detectors that are built have a network of one layer."""
    from linear_network import linear_network

    with linear_network():
        yield
