"""CenterPoint and the range view after equal samples and after equal time, with ten sweeps and with one.

    python -m experiments.studies.centerpoint  # smoke: minutes, a toy
    python -m experiments.studies.centerpoint --scale sector  # 6 rows, 18 cells
    python -m experiments.studies.centerpoint --scale sector --second-look  # 4 rows, 12 cells

Both use the points of the same sweeps in the sector, the same training, augmentation, optimizer, post-processing
and evaluation, and the same number of NMS candidates. CenterPoint has the pillars of its compact preset and
predicts no IoU. The range view has rows with local geometry, which ``compact`` has, and rows without it, as in the
paper. With ``--second-look``, both have the second look of ``compact``, trained afterwards on the boxes of the
frozen detector; curves and times of steps are without it. The comparison favours the range view: learning rate and
NMS were chosen for ``compact``, and CenterPoint computes a whole square although the sector covers a quarter of
it.

The steps of both are timed in turns. CenterPoint's steps take longer, so it sees fewer samples in equal time. Its
mAP there is read from its learning curve, in the middle of its schedule. These times, and the times of the stages
from cloud to boxes, need no training (``--only-figures``). They are of random weights, which have fewer candidates
than trained ones, so the times of the stage ``boxes`` cannot be compared. The paper compares both in table 7, but
not after equal training. Cost: one hour of a CPU core per cell. Expected: CenterPoint leads after equal samples
and equal time.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from experiments.benchmarks.latency import stage_calls
from experiments.changes import FROZEN_LOOK, as_centerpoint, change
from experiments.paper_tables.tables import Args, Row, Table, run_table, simulated_scale
from experiments.runs import training_steps
from experiments.script import run_script
from experiments.statistics import gain
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference.timing import Call, interleaved
from fcos_lidar_jax.models import build_detector, count_parameters

_STAGES = {
    "image or pillars": "preparation",
    "network": "network",
    "boxes": "post-processing",
    "second look": "second look",
}


def _rows(sweeps: str, **fields: Any) -> tuple[Row, ...]:
    """Rows with a number of sweeps, compared with CenterPoint on the same sweeps."""
    peer = Row(f"CenterPoint, {sweeps}", lambda config: as_centerpoint(change(**fields)(config)))
    ours = Row(f"FCOS-LiDAR, {sweeps}", change(model__local_geometry=True, **fields), reference=peer.label)
    plain = f"FCOS-LiDAR without local geometry, {sweeps}"
    return peer, ours, Row(plain, change(**fields), reference=peer.label)


ROWS = _rows("ten sweeps") + _rows("one sweep", num_sweeps=1)
PEER = ROWS[0]
_LOOKS = {"refinement": FROZEN_LOOK}
ROWS_WITH_SECOND_LOOK = _rows("ten sweeps", **_LOOKS)[:2] + _rows("one sweep", num_sweeps=1, **_LOOKS)[:2]


@dataclasses.dataclass(frozen=True)
class PeerArgs(Args):
    """Options of the table."""

    second_look: bool = False  # Both detectors with a second look.


def figures(args: Args, table: Table) -> dict[str, Any]:
    """Measure times of the stages and of a training step, and count parameters, by row."""
    scale = simulated_scale(args)
    assert scale is not None
    calls, columns = dict[tuple[str, str], Call](), {}
    for row in table.only(args.rows).rows:
        config = row.change(scale.base)
        frame = scale.frames("test", config.num_sweeps).frame(0)
        detector = build_detector(config, scale.sensor)
        variables = detector.init(jax.random.key(0))
        cloud = make_cloud(frame.points, config, sensor=scale.sensor, num_close=0)
        stages = stage_calls(detector, variables, cloud)
        calls |= {(row.label, label): stages[stage] for label, stage in _STAGES.items() if stage in stages}
        detecting = dataclasses.replace(config, refinement=None)
        calls[row.label, "training step"] = training_steps(detecting, scale.sensor, [frame])
        columns[row.label] = {"parameters, thousands": count_parameters(variables["params"])["total"] / 1000}
    measured = interleaved(calls, 2 if args.scale == "smoke" else 15)
    for (label, stage), times in measured.items():
        columns[label][f"{stage}, ms"] = times["median_ms"]
    return {"columns": columns, "lines": []}


def equal_time(record: dict[str, Any]) -> Iterator[str]:
    """Compare each row at its end with CenterPoint after as much time, on the frames of the learning curves."""
    rows, columns = {row["label"]: row for row in record["rows"]}, record["figures"]["columns"]
    for label, row in rows.items():
        if label.startswith("CenterPoint"):
            continue
        name = row["reference"]
        own, peer = (
            [np.array(cell["curve"]) for cell in rows[n].get("scores", ()) if cell] for n in (label, name)
        )
        if own and peer:
            ratio = columns[label]["training step, ms"] / columns[name]["training step, ms"]
            seen = min(ratio * own[0][-1, 0], peer[0][-1, 0])
            ends = [100 * curve[-1, 1] for curve in own]
            theirs = [100 * float(np.interp(seen, *curve.T)) for curve in peer]
            bounds = gain(theirs, ends)
            lead = ", {:+.1f} [{:+.1f}, {:+.1f}]".format(*bounds) if bounds else ""
            yield (
                f"{label}: a training step takes {ratio:.2f} of the time of {name}. mAP on the frames of the "
                f"curves: {_listed(ends)} at the end; {name} after as much time, {seen:.0f} samples: "
                f"{_listed(theirs)}{lead}."
            )


def _listed(scores: list[float]) -> str:
    return ", ".join(f"{score:.1f}" for score in scores)


def make_table(*, second_look: bool = False) -> Table:
    """Create the table; its files are named after the second look."""
    name = "centerpoint" + "_second_look" * second_look
    title = "CenterPoint and the range view" + ", with a second look" * second_look
    rows = ROWS_WITH_SECOND_LOOK if second_look else ROWS
    table = Table(name, title, rows, reference=PEER.label, lines=None if second_look else equal_time)
    return dataclasses.replace(table, figures=lambda args: figures(args, table))


TABLE, WITH_SECOND_LOOK = make_table(), make_table(second_look=True)


def main(args: PeerArgs) -> None:
    """Train and print the table."""
    if args.scale == "nuscenes":
        raise ValueError("--scale: got nuscenes, expected smoke or sector")
    run_table(make_table(second_look=args.second_look), args)


if __name__ == "__main__":
    run_script(main, PeerArgs, __doc__)
