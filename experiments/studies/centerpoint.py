"""CenterPoint and the range view after equal samples and after equal time.

    python -m experiments.studies.centerpoint  # smoke: minutes, a toy
    python -m experiments.studies.centerpoint --scale sector  # 3 rows, 9 cells

Both use the points of the same ten sweeps in the sector, the same training, augmentation, optimizer,
post-processing and evaluation, and the same number of NMS candidates. CenterPoint has the pillars of its compact
preset and predicts no IoU. The comparison favours the range view: learning rate and NMS were chosen for
``compact``, which has more parameters, and CenterPoint computes a whole square although the sector covers a
quarter of it. As its steps therefore take longer, one row trains the range view for half as many epochs again.

The minutes of the training steps are printed below the table; other work may have shared the machine, so the steps
are also timed in turns. These times, and the times of the stages from cloud to boxes, need no training
(``--only-figures``). They are of random weights, which have fewer candidates than trained ones, so the times of
the stage ``boxes`` cannot be compared. The paper compares both in table 7, but not after equal training.
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

_MORE_EPOCHS = 1.5  # Factor with which the range view takes about as long as CenterPoint.
_CANDIDATES = 4450  # Candidates of the range view on all levels; the coarsest have less than 1000 each.


def _trained_longer(config: Config) -> Config:
    return change(optimizer__epochs=round(_MORE_EPOCHS * config.optimizer.epochs))(config)


def _peer(config: Config) -> Config:
    own = {part: getattr(CENTERPOINT_COMPACT, part) for part in ("model", "loss", "pillars")}
    change_shared = change(inference__iou_exponent=1.0, inference__candidates_per_level=_CANDIDATES)
    return CenterPointConfig.of(change_shared(config), **own)


OURS = Row("FCOS-LiDAR", change())
PEER = Row("CenterPoint", _peer)
ROWS = (PEER, OURS, Row(f"FCOS-LiDAR, {_MORE_EPOCHS} x epochs", _trained_longer))


def stage_calls(config: Config, points: Any, sensor: Any) -> tuple[dict[str, Call], int]:
    """Make timed calls of a detector's stages on one cloud with random weights; also returns its parameters."""
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
    """Measure times of the stages and of a training step, and count parameters, by row."""
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
    """Train and print the table."""
    if args.scale == "nuscenes":
        raise ValueError("--scale: got nuscenes, expected smoke or sector")
    run_table(TABLE, args)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
