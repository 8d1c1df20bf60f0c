"""Table 7: times of the stages from sweep files to boxes, for one sweep and ten, batch size 1.

    python -m experiments.benchmarks.latency  # on FCOS_LIDAR_REAL_DATA's cloud, else a simulated one
    python -m experiments.benchmarks.latency --precision bfloat16  # on a GPU

All stages of one sweep and of ten run in turns. The paper's "Backbone" is taken as preprocessing (normalise,
repeat rows, pad), stem and backbone, its "Heads" as pyramid and heads, which are also timed separately. Its table
omits post-processing. Reading files and composing poses is timed on a simulated data set with sweep files of the
real size. The background prior is 0.5, so that an untrained network proposes boxes everywhere, the worst case for
NMS. NMS has the form that suits the platform.

Cost: 15 repeats take about six minutes on two CPU cores. Expected: MRV takes well below one per cent of the time,
and the network's time does not depend on the number of sweeps, since the number of rounds is the same.
"""

import contextlib
import dataclasses
import functools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.changes import change
from experiments.paper import PAPER
from experiments.script import Options, find_real_data, run_measurement
from fcos_lidar_jax.config import CloudReading, Config
from fcos_lidar_jax.data.cloud_policy import Cloud, make_cloud
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.inference import make_detect, make_stages
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.locations import image_layout
from fcos_lidar_jax.models import Detector, Variables, build_detector
from fcos_lidar_jax.models.detector import Network, network_input
from fcos_lidar_jax.presets import NUSCENES, NUSCENES_SINGLE, PRESETS
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor, load_sensor
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import DatasetSpec

ROWS = {"single": NUSCENES_SINGLE.max_points, "multi": NUSCENES.max_points}
"""Setting of table 7 -> rows to which clouds are padded."""
PAPER_STAGES = {
    "MRV": "projection_ms",
    "Backbone (stem and backbone)": "backbone_ms",
    "Heads (pyramid and heads)": "heads_ms",
}
"""Stage -> column of the paper's table 7; "overall_ms" is their sum."""


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """Options of the measurement."""

    preset: Literal["nuscenes", "nuscenes_single", "quickstart"] = "nuscenes"  # Configuration preset.
    precision: Literal["float32", "bfloat16"] = "float32"  # Of the convolutions.
    data: Path | None = None
    """Folder with ten_sweep_cloud/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated cloud."""
    repeats: int = 15  # Turns.


@contextlib.contextmanager
def simulated_sweeps(sensor: Sensor, keyframes: int = 2) -> Iterator[tuple[NuScenes, str]]:
    """Provide a simulated drive in the nuScenes layout and its last keyframe, with nine previous sweeps."""
    with tempfile.TemporaryDirectory() as folder:
        spec = DatasetSpec(1, 0, keyframes, sensor, False, "v1.0-synthetic")
        write_dataset(spec, Path(folder), workers=1, report=lambda _: None)
        data = NuScenes(folder, spec.version)
        yield data, data.sample_tokens[-1]


def real_cloud(data: Path | None) -> Path | None:
    """Find the file of the real ten-sweep cloud; see :func:`~experiments.script.find_real_data`."""
    return find_real_data(data, "ten_sweep_cloud", "cloud.f16.bin")


def fused_cloud(data: Path | None, sensor: Sensor) -> tuple[np.ndarray, str]:
    """Load ten sweeps in one cloud f32[n, 5], with the close points of the current sweep, and a description.

    The cloud is simulated without a folder with ``ten_sweep_cloud/``, and for sensors other than nuScenes'.
    """
    file = real_cloud(data)
    if file is not None and sensor == NUSCENES_HDL32E:
        return np.fromfile(file, np.float16).reshape(-1, 5).astype(np.float32), "real ten-sweep cloud"
    with simulated_sweeps(sensor) as (drive, token):
        return drive.fuse_sweeps(token, CloudReading(10))[0], "simulated ten-sweep cloud"


def padded(cloud: np.ndarray, setting: str, sensor: Sensor) -> Cloud:
    """Prepare the fused cloud, or only its current sweep, for the detector."""
    points = cloud[cloud[:, 4] == 0] if setting == "single" else cloud
    projection = dataclasses.replace(NUSCENES.projection, remove_close="all")
    config = dataclasses.replace(NUSCENES, max_points=ROWS[setting], projection=projection)
    return make_cloud(points, config, sensor=sensor)


def stage_calls(detector: Detector, variables: Variables, cloud: Cloud) -> dict[str, Call]:
    """Make calls of a detector's stages for one cloud, with precomputed inputs."""
    stages, detect = make_stages(detector), jax.jit(make_detect(detector))
    prepare, network, postprocess, refine = (
        jax.jit(stage) for stage in (stages.prepare, stages.network, stages.postprocess, stages.refine)
    )
    points, valid = jax.device_put((cloud.points, cloud.valid))
    sample = prepare(points, valid)
    outputs = network(variables, sample)
    boxes = postprocess(outputs, sample)
    calls: dict[str, Call] = {
        "transfer": lambda: jax.device_put((cloud.points, cloud.valid)),
        "preparation": lambda: prepare(points, valid),
        "network": lambda: network(variables, sample),
        "post-processing": lambda: postprocess(outputs, sample),
    }
    if detector.refine is not None:
        calls["second look"] = lambda: refine(variables, points, valid, *boxes)
    return calls | {"points to boxes, one program": lambda: detect(variables, points, valid)}


def path_calls(config: Config, sensor: Sensor, variables: Variables, cloud: Cloud) -> dict[str, Call]:
    """Make calls of FCOS-LiDAR's stages, and of the parts of its network, for one cloud.

    The configuration has no ``local_geometry``, which the parts would need as another input.
    """
    layout, network = image_layout(sensor, config.model), Network(config.model, len(config.classes))

    def part(apply: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
        """Compile methods of the network in sequence."""
        compiled = jax.jit(lambda variables, x: network.apply(variables, x, method=apply))
        return lambda x: compiled(variables, x)

    def backbone(whole: Any, features: Any) -> Any:
        return whole.backbone(whole.stem(network_input(features, config.model, layout), train=False), train=False)

    body, front = part(backbone), part(lambda whole, levels: whole.heads(whole.fpn(levels)))
    fpn, heads = part(lambda whole, levels: whole.fpn(levels)), part(lambda whole, pyramid: whole.heads(pyramid))
    calls = stage_calls(build_detector(config, sensor), variables, cloud)
    calls["MRV"] = calls.pop("preparation")
    features = calls["MRV"]().features[None]
    levels = body(features)
    pyramid = fpn(levels)
    return calls | {
        "Backbone (stem and backbone)": lambda: body(features),
        "Heads (pyramid and heads)": lambda: front(levels),
        "pyramid alone": lambda: fpn(levels),
        "heads alone": lambda: heads(pyramid),
    }


def load(drive: NuScenes, token: str, config: Config, sensor: Sensor, setting: str) -> np.ndarray:
    """Load a padded cloud from files."""
    number = 1 if setting == "single" else 10
    points, num_close = drive.fuse_sweeps(token, CloudReading(number, "all", config.projection.close_m))
    config = dataclasses.replace(config, max_points=ROWS[setting], num_sweeps=number)
    return make_cloud(points, config, sensor=sensor, num_close=num_close).points


def measure(args: Args) -> dict[str, Any]:
    """Measure all figures of table 7."""
    config = change(model__precision=args.precision, model__background_prior=0.5)(PRESETS[args.preset])
    sensor = load_sensor(config.sensor)
    fused, label = fused_cloud(args.data, sensor)
    clouds = {setting: padded(fused, setting, sensor) for setting in ROWS}
    variables = jax.jit(build_detector(config, sensor).init)(jax.random.key(0))
    calls: dict[tuple[str, str], Call] = {}
    with simulated_sweeps(sensor) as (drive, token):
        for setting, cloud in clouds.items():
            calls[setting, "loading (host)"] = functools.partial(load, drive, token, config, sensor, setting)
            calls |= {(setting, n): call for n, call in path_calls(config, sensor, variables, cloud).items()}
        found = interleaved(calls, args.repeats)
    rows = PAPER["tables"]["table7"]["rows"]
    return {
        "preset": config.name,
        "precision": args.precision,
        "cloud": label,
        "loading": "simulated data set in the nuScenes layout",
        "points": {setting: cloud.num_points for setting, cloud in clouds.items()},
        "repeats": args.repeats,
        "times": {setting: {name: ms for (of, name), ms in found.items() if of == setting} for setting in clouds},
        "paper": {"hardware": PAPER["times"], **{s: rows[f"FCOS-LiDAR, {s}"] for s in clouds}},
    }


if __name__ == "__main__":
    run_measurement(measure, Args, __doc__)
