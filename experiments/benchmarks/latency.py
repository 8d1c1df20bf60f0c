"""Table 7: where the time goes from sweep files to boxes, one sweep and ten, batch 1.

    python -m experiments.benchmarks.latency  # on FCOS_LIDAR_REAL_DATA's cloud, else a simulated one
    python -m experiments.benchmarks.latency --precision bfloat16  # on a GPU
    python -m experiments.benchmarks.latency --repeats 2  # a look

All stages, of one sweep and of ten, run turn by turn: the speed of a machine drifts. The paper's "Backbone" is cut
here as preprocessing (normalise, repeat rows, pad), stem and backbone, its "Heads" as pyramid and heads;
these two are also timed apart, for the other cut. Its table leaves post-processing out. Reading files and
composing poses is timed on a simulated data set in the nuScenes layout, whose sweep files are as large as the real
ones. The background's prior is 0.5, so that an untrained network proposes boxes everywhere: NMS at its busiest.

On a GPU all forms of stem and NMS are timed beside them; the stages use what suits the platform.

Cost: 15 turns take about six minutes on two CPU cores. Expected: MRV well below one per cent of the path, and a
network that is indifferent to the number of sweeps, since five rounds are five rounds.
"""

import contextlib
import dataclasses
import functools
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.benchmarks.stages import make_stages
from experiments.hardware import hardware_line
from experiments.paper import PAPER
from experiments.script import real_data, run_script, save
from experiments.statistics import Call, Times, interleaved
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.inference.cloud import Cloud, make_cloud
from fcos_lidar_jax.inference.detect import select_candidates
from fcos_lidar_jax.locations import image_layout, locate
from fcos_lidar_jax.models import Variables, build_detector
from fcos_lidar_jax.models.modality import Form, Stem
from fcos_lidar_jax.nms import rotated_nms
from fcos_lidar_jax.presets import NUSCENES, NUSCENES_SINGLE, PRESETS
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, Sensor, load_sensor
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import DatasetSpec

ROWS = {"single": NUSCENES_SINGLE.max_points, "multi": NUSCENES.max_points}
"""Setting of table 7 -> rows its clouds are padded to."""
_WHOLE = "points to boxes, one program"
STEM_FORMS: tuple[Form, ...] = ("split", "dense", "grouped")


@dataclasses.dataclass(frozen=True)
class Args:
    """What to time, and how often."""

    preset: Literal["nuscenes", "nuscenes_single", "quickstart"] = "nuscenes"
    """Configuration preset."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions."""
    data: Path | None = None
    """Folder with ten_sweep_cloud/; default: the environment's FCOS_LIDAR_REAL_DATA, else a simulated cloud."""
    repeats: int = 15
    """Turns."""
    out: Path = Path("outputs/latency.json")
    """Where the figures go."""


@contextlib.contextmanager
def simulated_sweeps(sensor: Sensor) -> Iterator[tuple[NuScenes, str]]:
    """A simulated drive in the nuScenes layout, while it is needed, and a keyframe with nine sweeps before it."""
    with tempfile.TemporaryDirectory() as folder:
        order = DatasetSpec(1, 0, 2, sensor, False, "v1.0-synthetic")
        write_dataset(order, Path(folder), workers=1, report=lambda _: None)
        data = NuScenes(folder, "v1.0-synthetic")
        yield data, data.sample_tokens[-1]


def real_cloud(data: Path | None) -> Path | None:
    """File of the real ten-sweep cloud, where a folder is named; see :func:`~experiments.script.real_data`."""
    return real_data(data, "ten_sweep_cloud", "cloud.f16.bin")


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
    return make_cloud(
        points, dataclasses.replace(NUSCENES, max_points=ROWS[setting]), sensor=sensor, remove_close=remove
    )


def path_calls(
    config: Config, sensor: Sensor, variables: Variables, clouds: Mapping[str, Cloud]
) -> dict[str, dict[str, Call]]:
    """The stages by setting and name, each with its input at hand."""
    stages = make_stages(config, sensor)
    detect = jax.jit(make_detect(build_detector(config, sensor)))
    body = jax.jit(lambda v, f: stages.backbone(v, stages.stem(v, stages.preprocess(f))))
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
            "post-processing": lambda: stages.postprocess(outputs, image),
            _WHOLE: lambda: detect(variables, points, valid),
        }

    return {setting: calls_of(cloud) for setting, cloud in clouds.items()}


def loading_calls(drive: NuScenes, token: str, config: Config, sensor: Sensor) -> dict[str, Call]:
    """Host work of both settings: files to a padded cloud."""

    def load(setting: str, num: int) -> Cloud:
        points = drive.sweeps(token, num, remove_close="all", close_m=config.projection.close_m)
        return make_cloud(
            points, dataclasses.replace(config, max_points=ROWS[setting]), sensor=sensor, remove_close="none"
        )

    return {"single": lambda: load("single", 1).points, "multi": lambda: load("multi", 10).points}


def form_times(config: Config, sensor: Sensor, variables: Variables, cloud: Cloud) -> dict[str, dict[str, Times]]:
    """The times of all forms of stem and NMS; the stages take the one that suits the platform."""
    model, choices, layout = config.model, config.inference, image_layout(sensor, config.model)
    stages = make_stages(config, sensor)
    image = stages.project(*jax.device_put((cloud.points, cloud.valid)))
    seen = stages.preprocess(image.features[None])
    levels = stages.fpn(variables, stages.backbone(variables, stages.stem(variables, seen)))
    outputs = jax.tree.map(lambda leaf: leaf[0], stages.heads(variables, levels))
    select = functools.partial(select_candidates, config=choices, layout=layout)
    boxes, scores, labels, valid = jax.jit(lambda o, i: select(o, locate(i, layout)))(outputs, image)
    own = {kind: tree["stem"] for kind, tree in variables.items()}

    def stem(form: Form) -> Call:
        module = Stem(model.stem, model.circular_width, model.precision, form)
        return functools.partial(jax.jit(functools.partial(module.apply, train=False)), own, seen)

    def nms(form: Literal["rows", "matrix"]) -> Call:
        options = {
            "iou_threshold": choices.iou_threshold,
            "max_outputs": choices.max_detections,
            "overlap": choices.nms_overlap,
            "form": form,
        }
        suppress = jax.jit(lambda b, s, v, labels: rotated_nms(b, s, v, labels=labels, **options))
        return lambda: suppress(boxes, scores, valid, labels)

    return {
        "stem": interleaved({form: stem(form) for form in STEM_FORMS}, 10),
        "nms": interleaved({form: nms(form) for form in ("rows", "matrix")}, 10),
    }


def measure(args: Args) -> dict[str, Any]:
    """All figures of table 7."""
    config = PRESETS[args.preset]
    model = dataclasses.replace(config.model, precision=args.precision, background_prior=0.5)
    config, sensor = dataclasses.replace(config, model=model), load_sensor(config.sensor)
    raw, label = fused_cloud(args.data, sensor)
    clouds = {setting: padded(raw, setting, sensor) for setting in ROWS}
    variables = jax.jit(build_detector(config, sensor).init)(jax.random.key(0))
    on_gpu = jax.default_backend() == "gpu"  # the others take seconds on a CPU
    forms = form_times(config, sensor, variables, clouds["multi"]) if on_gpu else None
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
        "comparable": args.preset != "quickstart" and "3090" in jax.devices()[0].device_kind,
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
        f"{hardware_line()}, {record['precision']}, "
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
    record = measure(args)
    save(record, args.out, as_text(record))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
