"""Table 7: where the time goes from sweep files to boxes, one sweep and ten, batch 1.

    python experiments/latency.py                        # on FCOS_LIDAR_REAL_DATA's cloud, else a simulated one
    python experiments/latency.py --precision bfloat16   # on a GPU
    python experiments/latency.py --repeats 2            # a look

All stages, of one sweep and of ten, run turn by turn: the speed of a machine drifts. The paper's "Backbone" is cut
here as the network's door (normalise, repeat rows, pad), stem and backbone, its "Heads" as pyramid and heads;
these two are also timed apart, for the other cut. Its table leaves post-processing out. Reading files and
composing poses is timed on a simulated data set in the nuScenes layout, whose sweep files are as large as the real
ones. The background's prior is 0.5, so that an untrained network proposes boxes everywhere: NMS at its busiest.

On a GPU all formulations of stem and NMS are timed first, and the fastest are used; a CPU uses the preset's.

Cost: 15 turns take about six minutes on two CPU cores. Expected: MRV well below one per cent of the path, and a
network that is indifferent to the number of sweeps, since five rounds are five rounds.
"""

import contextlib
import dataclasses
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro
from full_size import make_stages
from hardware import hardware

from fcos_lidar_jax.cli import exit_code
from fcos_lidar_jax.commands.clouds import Cloud, make_cloud
from fcos_lidar_jax.config import NUSCENES, NUSCENES_SINGLE, PRESETS, Config
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.synthetic.dataset import write_dataset
from fcos_lidar_jax.data.synthetic.render import Order
from fcos_lidar_jax.files import write_beside
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor, load_sensor

PAPER = json.loads(Path(__file__).with_name("paper.json").read_text(encoding="utf-8"))
ROWS = {"single": NUSCENES_SINGLE.max_points, "multi": NUSCENES.max_points}
"""Setting of table 7 -> rows its clouds are padded to."""
_WHOLE = "points to boxes, one program"
STEM_FORMS: tuple[Literal["split", "dense", "grouped"], ...] = ("split", "dense", "grouped")
Call = Callable[[], Any]
Times = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Args:
    """What to time, and how often."""

    preset: str = "nuscenes"
    """Configuration preset."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions."""
    data: Path | None = None
    """Folder with ten_sweep_cloud/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated cloud."""
    repeats: int = 15
    """Turns."""
    out: Path = Path("outputs/latency.json")
    """Where the figures go."""


def interleaved(calls: Mapping[str, Call], repeats: int) -> dict[str, Times]:
    """Median and 99th percentile of calls that take turns, in milliseconds, after one run each that compiles.

    With fewer than a hundred turns the percentile is close to the slowest.

    Raises:
        ValueError: no turn at all.
    """
    if repeats < 1:
        raise ValueError(f"repeats: got {repeats}, expected at least 1")
    for call in calls.values():
        jax.block_until_ready(call())
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            found[name].append(1e3 * (time.perf_counter() - began))
    return {
        name: {"median_ms": round(float(np.median(ms)), 3), "p99_ms": round(float(np.percentile(ms, 99)), 3)}
        for name, ms in found.items()
    }


@contextlib.contextmanager
def simulated_sweeps(sensor: Sensor) -> Iterator[tuple[NuScenes, str]]:
    """A simulated drive in the nuScenes layout, while it is needed, and a keyframe with nine sweeps before it."""
    with tempfile.TemporaryDirectory() as folder:
        order = Order(1, 0, 2, sensor, False, "v1.0-synthetic")
        write_dataset(order, Path(folder), workers=1, report=lambda _: None)
        data = NuScenes(folder, "v1.0-synthetic")
        yield data, data.sample_tokens[-1]


def real_cloud(data: Path | None) -> Path | None:
    """File of the real ten-sweep cloud, where a folder is named.

    Args:
        data: folder with ``ten_sweep_cloud/``; None for the environment's, if it names one.

    Raises:
        ValueError: it is not there.
    """
    folder = data or os.environ.get("FCOS_LIDAR_REAL_DATA")
    if not folder:
        return None
    file = Path(folder) / "ten_sweep_cloud" / "cloud.f16.bin"
    if not file.is_file():
        name = "FCOS_LIDAR_REAL_DATA" if data is None else "--data"
        raise ValueError(f"{name}: {folder}: no ten_sweep_cloud/cloud.f16.bin there")
    return file


def fused_cloud(data: Path | None, sensor: Sensor) -> tuple[np.ndarray, str]:
    """Ten sweeps in one cloud, f32[n, 5], the close points of the current sweep still there; and what it is.

    Args:
        data: folder with ``ten_sweep_cloud/``; None for the environment's, or a simulated cloud.
        sensor: a real cloud is nuScenes' sensor's alone.
    """
    file = real_cloud(data)
    if file is not None and sensor == NUSCENES_HDL32E:
        raw = np.fromfile(file, np.float16)
        return raw.reshape(-1, 5).astype(np.float32), "real ten-sweep cloud"
    with simulated_sweeps(sensor) as (drive, token):
        return drive.sweeps(token, 10, remove_close="sweeps"), "simulated ten-sweep cloud"


def padded(cloud: np.ndarray, setting: str, sensor: Sensor, remove: str = "all") -> Cloud:
    """The fused cloud, or its current sweep alone, as the detector gets it."""
    points = cloud[cloud[:, 4] == 0] if setting == "single" else cloud
    return make_cloud(points, sensor, size=ROWS[setting], remove=remove)


def path_calls(
    config: Config, sensor: Sensor, variables: Variables, clouds: Mapping[str, Cloud]
) -> dict[str, dict[str, Call]]:
    """The stages by setting and name, each with its input at hand."""
    stages = make_stages(config, sensor)
    detect = jax.jit(make_detect(build_detector(config, sensor), config, sensor))
    body = jax.jit(lambda v, f: stages.backbone(v, stages.stem(v, stages.door(f))))
    front = jax.jit(lambda v, levels: stages.heads(v, stages.fpn(v, levels)))

    def calls_of(cloud: Cloud) -> dict[str, Call]:
        points, valid = jax.device_put((cloud.points, cloud.valid))
        image = stages.project(points, valid)
        levels = body(variables, image.features[None])
        pyramid = stages.fpn(variables, levels)
        outputs = jax.tree.map(lambda leaf: leaf[0], front(variables, levels))
        return {
            "transfer": lambda: jax.device_put((cloud.points, cloud.valid)),
            "MRV": lambda: stages.project(points, valid),
            "Backbone (stem and backbone)": lambda: body(variables, image.features[None]),
            "Heads (pyramid and heads)": lambda: front(variables, levels),
            "pyramid alone": lambda: stages.fpn(variables, levels),
            "heads alone": lambda: stages.heads(variables, pyramid),
            "post-processing": lambda: stages.finish(outputs, image),
            _WHOLE: lambda: detect(variables, points, valid),
        }

    return {setting: calls_of(cloud) for setting, cloud in clouds.items()}


def loading_calls(drive: NuScenes, token: str, config: Config, sensor: Sensor) -> dict[str, Call]:
    """Host work of both settings: files to a padded cloud."""

    def load(setting: str, num: int) -> Cloud:
        points = drive.sweeps(token, num, remove_close="all", close_m=config.projection.close_m)
        return make_cloud(points, sensor, size=ROWS[setting], remove="none")

    return {"single": lambda: load("single", 1).points, "multi": lambda: load("multi", 10).points}


def with_fastest_forms(config: Config, sensor: Sensor, variables: Variables, cloud: Cloud) -> tuple[Config, Any]:
    """On a GPU: the formulations of stem and NMS that are fastest there, and the times of all."""
    model = config.model
    points, valid = jax.device_put((cloud.points, cloud.valid))
    first = make_stages(config, sensor)
    image = first.project(points, valid)
    seen = first.door(image.features[None])
    levels = first.fpn(variables, first.backbone(variables, first.stem(variables, seen)))
    outputs = jax.tree.map(lambda leaf: leaf[0], first.heads(variables, levels))
    stems = {form: dataclasses.replace(model.stem, form=form) for form in STEM_FORMS}
    configs = {f: dataclasses.replace(config, model=dataclasses.replace(model, stem=s)) for f, s in stems.items()}
    nms = {form: dataclasses.replace(config.inference, nms_form=form) for form in ("rows", "matrix")}
    nms_configs = {form: dataclasses.replace(config, inference=choice) for form, choice in nms.items()}
    parts = {form: make_stages(c, sensor) for form, c in (configs | nms_configs).items()}
    stem_ms = interleaved({f: lambda f=f: parts[f].stem(variables, seen) for f in configs}, 10)
    finish_ms = interleaved({f: lambda f=f: parts[f].finish(outputs, image) for f in nms_configs}, 10)

    def fastest(times: dict[str, Times]) -> str:
        return min(times, key=lambda form: times[form]["median_ms"])

    chosen = dataclasses.replace(configs[fastest(stem_ms)], inference=nms[fastest(finish_ms)])
    return chosen, {"stem": stem_ms, "post-processing": finish_ms}


def measure(args: Args) -> dict[str, Any]:
    """All figures of table 7."""
    config = PRESETS[args.preset]
    model = dataclasses.replace(config.model, precision=args.precision, background_prior=0.5)
    config, sensor = dataclasses.replace(config, model=model), load_sensor(config.sensor)
    raw, label = fused_cloud(args.data, sensor)
    clouds = {setting: padded(raw, setting, sensor) for setting in ROWS}
    variables = jax.jit(build_detector(config, sensor).init)(jax.random.key(0))
    forms = None
    if jax.default_backend() == "gpu":
        config, forms = with_fastest_forms(config, sensor, variables, clouds["multi"])
    with simulated_sweeps(sensor) as (drive, token):
        loading = loading_calls(drive, token, config, sensor)
        calls = {
            f"{setting}/{name}": call
            for setting, path in path_calls(config, sensor, variables, clouds).items()
            for name, call in {"loading (host)": loading[setting], **path}.items()
        }
        found = interleaved(calls, args.repeats)
    return {
        "preset": config.name,
        "precision": args.precision,
        "cloud": label,
        "loading": "simulated data set in the nuScenes layout",
        "points": {setting: cloud.num_points for setting, cloud in clouds.items()},
        "stem_form": config.model.stem.form,
        "nms_form": config.inference.nms_form,
        "forms": forms,
        "repeats": args.repeats,
        "times": {
            setting: {name.split("/", 1)[1]: ms for name, ms in found.items() if name.startswith(setting)}
            for setting in clouds
        },
        "paper": {
            "hardware": PAPER["times"],
            **{s: PAPER["tables"]["table7"]["rows"][f"FCOS-LiDAR, {s}"] for s in clouds},
        },
        "comparable": args.preset in ("nuscenes", "nuscenes_single") and "3090" in jax.devices()[0].device_kind,
        **hardware(),
    }


_PAPER_COLUMN = {
    "MRV": "projection_ms",
    "Backbone (stem and backbone)": "backbone_ms",
    "Heads (pyramid and heads)": "heads_ms",
}


def as_text(record: dict[str, Any]) -> str:
    """The table, ours beside the paper's."""
    single, multi = (record["times"][setting] for setting in ROWS)
    paper = record["paper"]
    note = "" if record["comparable"] else "; other hardware or another network, not comparable"
    lines = [
        f"{record['device']} ({record['processor']}, {record['cores']} cores), {record['precision']}, "
        f"{record['cloud']}; ms, median and 99th percentile of {record['repeats']} turns",
        f"paper: {paper['hardware']}{note}",
        f"{'':32s}{'one sweep':>20s}{'ten sweeps':>22s}{'paper, one':>14s}{'ten':>8s}",
    ]

    def line(name: str, one: Times, ten: Times, column: str | None) -> str:
        theirs = [paper[setting][column] if column else "" for setting in ROWS]
        ours = "".join(f"{t['median_ms']:12.2f}{t.get('p99_ms', float('nan')):10.2f}" for t in (one, ten))
        return f"{name:30s}{ours.replace('nan', '   ')}{theirs[0]!s:>12s}{theirs[1]!s:>8s}"

    lines += [line(name, single[name], multi[name], _PAPER_COLUMN.get(name)) for name in single]

    def total(name: str, parts: Iterable[str], column: str | None) -> str:
        one, ten = (sum((times[part]["median_ms"] for part in parts), 0.0) for times in (single, multi))
        return line(name, {"median_ms": one}, {"median_ms": ten}, column)

    lines.append(total("sum: MRV, Backbone, Heads", tuple(_PAPER_COLUMN), "overall_ms"))
    lines.append(total("sum: Backbone and pyramid", ("Backbone (stem and backbone)", "pyramid alone"), None))
    lines.append(total("sum: sweep files to boxes", ("loading (host)", "transfer", _WHOLE), None))
    for part, times in (record["forms"] or {}).items():
        told = ", ".join(f"{form} {ms['median_ms']:.3f}" for form, ms in times.items())
        lines.append(f"{part} by formulation, ms: {told}")
    return "\n".join(lines)


def main(args: Args) -> None:
    """Measure, print, write."""
    if args.preset not in PRESETS:
        raise SystemExit(f"error: --preset: got {args.preset!r}, expected one of {', '.join(PRESETS)}")
    record = measure(args)
    print(as_text(record))
    write_beside(args.out, lambda path: path.write_text(json.dumps(record, indent=1)))


if __name__ == "__main__":
    sys.exit(exit_code("latency.py", lambda: main(tyro.cli(Args, description=__doc__))))
