"""CenterPoint beside the range view: what both find after the same samples and after the same time.

    python -m experiments.studies.centerpoint  # smoke: minutes, a toy
    python -m experiments.studies.centerpoint --scale sector  # 3 rows, 9 cells

Both see the points of the same ten sweeps that lie in the sector, and share trainer, augmentation, optimizer,
post-processing and evaluation; both may send as many candidates to NMS. CenterPoint has the pillars of its
compact preset, and predicts no IoU. What favours the range view here: learning rate and NMS were chosen for
``compact``, which has more parameters (the table says how many), and CenterPoint computes a whole square, of
which a sector sees a quarter. Its steps take longer for that, and the range view is trained for half as many
epochs again in a row of its own. The minutes that the steps took stand below the table, beside the scores by
class and by range; other work may have shared the machine, so what a step costs is timed as well, turn by turn.
That, and the times from a cloud to boxes in the form of the paper's table 7, need no training
(``--only-figures``): they are those of random weights, whose candidates are not as many as a trained detector's,
so the stage of the boxes is not to be compared.

The paper compares itself with CenterPoint in table 7 and has no table of both after equal training.
"""

from typing import Any

import jax

from experiments.benchmarks.training_steps import training_steps
from experiments.changes import change
from experiments.paper_tables.tables import Args, Row, Table, run_table, simulated_scale
from experiments.script import run_script
from fcos_lidar_jax.centerpoint import CenterPointConfig
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference.detect import make_stages
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.models import build_detector, count_parameters
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT

_AS_LONG = 1.5  # Times the epochs of the scale, in which CenterPoint takes about as long.
_CANDIDATES = (
    4450  # As many as the range view has on all of its levels, of which the coarsest hold less than 1000.
)


def _as_long(config: Config) -> Config:
    return change(optimizer__epochs=round(_AS_LONG * config.optimizer.epochs))(config)


def _peer(config: Config) -> Config:
    own = {part: getattr(CENTERPOINT_COMPACT, part) for part in ("model", "loss", "pillars")}
    change_shared = change(inference__iou_exponent=1.0, inference__candidates_per_level=_CANDIDATES)
    return CenterPointConfig.of(change_shared(config), **own)


OURS = Row("FCOS-LiDAR", change())
PEER = Row("CenterPoint", _peer)
ROWS = (PEER, OURS, Row(f"FCOS-LiDAR, {_AS_LONG} x epochs", _as_long))


def stage_calls(config: Config, points: Any, sensor: Any) -> tuple[dict[str, Call], int]:
    """The stages of a detector with random weights on one cloud, each to be timed alone, and its parameters."""
    detector = build_detector(config, sensor)
    stages, variables = make_stages(detector), detector.init(jax.random.key(0))
    cloud = make_cloud(points, config, sensor=sensor, num_close=0)
    prepare, network, boxes = (jax.jit(part) for part in (stages.prepare, stages.network, stages.postprocess))
    image = prepare(cloud.points, cloud.valid)
    outputs = network(variables, image)
    calls: dict[str, Call] = {
        "image or pillars": lambda: prepare(cloud.points, cloud.valid),
        "network": lambda: network(variables, image),
        "boxes": lambda: boxes(outputs, image),
    }
    return calls, count_parameters(variables["params"])["total"]


def figures(args: Args) -> dict[str, Any]:
    """Times of the stages and of a training step, and parameters, by row."""
    scale = simulated_scale(args)
    assert scale is not None
    frame, calls, columns = scale.frames("test", scale.base.num_sweeps).frame(0), dict[tuple[str, str], Call](), {}
    for row in (OURS, PEER):
        config = row.change(scale.base)
        parts, parameters = stage_calls(config, frame.points, scale.sensor)
        parts["training step"] = training_steps(config, scale.sensor, [frame])
        calls |= {(row.label, stage): call for stage, call in parts.items()}
        columns[row.label] = {"parameters, thousands": parameters / 1000}
    measured = interleaved(calls, 2 if args.scale == "smoke" else 15)
    for (label, stage), times in measured.items():
        columns[label][f"{stage}, ms"] = times["median_ms"]
    return {"columns": columns, "lines": []}


TABLE = Table("centerpoint", "CenterPoint and the range view", ROWS, reference=PEER.label, figures=figures)


def main(args: Args) -> None:
    """The table."""
    if args.scale == "nuscenes":
        raise ValueError("--scale: got nuscenes, expected smoke or sector")
    run_table(TABLE, args)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
