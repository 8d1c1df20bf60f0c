"""Table 8: the test-set model: wider heads ("c128"), no pasted objects at the end ("fade"), the results file.

    python -m experiments.paper_tables.table8_test_submission  # smoke: minutes, a toy
    python -m experiments.paper_tables.table8_test_submission --scale sector  # 4 rows, 12 cells
    python -m experiments.paper_tables.table8_test_submission --scale nuscenes --data-root DIR --test-version V

The results file is ``results_nusc.json``, for the server at nuScenes: of the test split at full scale, of a
simulated one otherwise. The other systems' rows are the paper's quotations. Expected of the paper: c128 is worth
about 0.6 points of mAP, on the validation set; fade about 2, of which set it does not say.
"""

import json
from pathlib import Path
from typing import Any

from experiments.changes import change
from experiments.paper import PAPER
from experiments.paper_tables.cells import changes_of, read_cells, run_name
from experiments.paper_tables.scales import NuScenesLayout, write_submission
from experiments.paper_tables.tables import Args, Row, Table, make_scale, run_table
from experiments.script import run_script
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import DatasetSpec
from fcos_lidar_jax.training.plan import RUN_SPEC

_PART_FADED = 8  # The paper's five epochs of forty.
_SUBMITTED = "c128 and fade"  # Row whose detector writes the results file.


def pasting(config: Config) -> Config:
    """With copy-paste, where the scale does without."""
    return config if config.copy_paste else change(copy_paste=QUICKSTART.copy_paste)(config)


def faded(config: Config) -> Config:
    """Without copy-paste in the last eighth of the epochs, at least one."""
    return change(fade_epochs=max(config.optimizer.epochs // _PART_FADED, 1))(pasting(config))


def wide(config: Config) -> Config:
    """With twice the channels in the heads."""
    return change(model__head_channels=2 * config.model.head_channels)(config)


def finished(run: Path) -> bool:
    """Whether the folder holds a run's last checkpoint."""
    spec, kept = run / RUN_SPEC, Checkpoints(run / CHECKPOINTS).paths()
    return bool(kept) and int(kept[-1].name) == json.loads(spec.read_text(encoding="utf-8"))["steps"]


def submission(args: Args) -> list[str]:
    """Write the results file of the trained c128 with fade, and say where."""
    scale, seed = make_scale(args), args.seeds[0] if args.seeds else 0
    config = wide(faded(scale.base))
    changes = changes_of(config, scale.base)
    known = read_cells(args.out / args.scale, scale).get((changes, seed))
    if known is None:
        return [f'No results file: the row "{_SUBMITTED}" was not trained with seed {seed}.']
    if "diverged" in known:
        return [f"No results file: the training of seed {seed} diverged."]
    run = args.runs / args.scale / run_name(changes, seed)
    if not finished(run):
        return [f"No results file: no finished run in {run}, the cell was trained elsewhere."]
    if isinstance(scale, NuScenesLayout):
        if scale.layout.test_version is None:
            return ["No results file: no --test-version."]
        frames = scale.frames("test", config, scale.layout.test_version)
    else:
        root, version = args.runs / "frames" / f"{scale.sensor.name}_submission", "v1.0-synthetic"
        spec = DatasetSpec(2, 0, 3, scale.sensor, scale.streets.rolling_shutter, version, scale.streets)
        write_dataset(spec, root, workers=1, report=lambda _: None)
        data = NuScenes(root, version)
        frames = NuScenesFrames(data, tuple(data.split("val")), config.reading, scale.sensor)
    file = args.out / args.scale / "submission" / "results_nusc.json"
    write_submission(load_detector(run), frames, file)
    return [f"Results file for {len(frames)} keyframes: {file}, {file.stat().st_size} bytes."]


def figures(args: Args) -> dict[str, Any]:
    """The paper's rows, and the results file."""
    quoted = PAPER["tables"]["table8"]["rows"]
    lines = ["Test set, paper (quoted there from the systems' own papers):", ""]
    lines += ["| method | mAP | NDS |", "|---|---|---|"]
    lines += [f"| {name} | {row['mAP']} | {row['NDS']} |" for name, row in quoted.items()]
    return {"lines": [*lines, "", *([] if args.only_figures else submission(args))]}


TABLE = Table(
    "table8",
    "Table 8: the test-set model",
    (
        Row("base", pasting),
        Row("fade", faded, gain="gain_of_fade"),
        Row("c128", lambda config: wide(pasting(config)), gain="gain_of_c128"),
        Row(_SUBMITTED, lambda config: wide(faded(config))),
    ),
    reference="base",
    figures=figures,
)

if __name__ == "__main__":
    run_script(lambda args: run_table(TABLE, args), Args, __doc__)
