"""Table 8: the test-set model with wider heads ("c128") and copy-paste switched off at the end ("fade").

With ``--test-version``, writes ``results_nusc.json`` of its split ``test`` for the nuScenes server. The rows of
other systems are quoted from the paper. The paper: c128 gains about 0.6 mAP on the validation set; fade gains
about 2, on a set that it does not name.
"""

from typing import Any

from experiments.changes import change
from experiments.paper import PAPER
from experiments.paper_tables.cells import changes_of, read_cells, run_name
from experiments.paper_tables.scales import NuScenesLayout, write_submission
from experiments.paper_tables.tables import Args, Row, Table, make_scale
from experiments.script import markdown_table
from fcos_lidar_jax.checkpoints.retention import CHECKPOINTS, Checkpoints
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.files import read_json
from fcos_lidar_jax.inference import load_detector
from fcos_lidar_jax.presets import QUICKSTART
from fcos_lidar_jax.training.plan import RUN_SPEC

_FADED_PART = 8  # Five of forty epochs in the paper.
_SUBMITTED = "c128 and fade"  # Row of the detector that writes the results file.


def pasting(config: Config) -> Config:
    """Add copy-paste if the scale does without."""
    return config if config.copy_paste else change(copy_paste=QUICKSTART.copy_paste)(config)


def faded(config: Config) -> Config:
    """Switch copy-paste off in the last eighth of the epochs, at least one."""
    return change(fade_epochs=max(config.optimizer.epochs // _FADED_PART, 1))(pasting(config))


def wide(config: Config) -> Config:
    """Double the channels of the heads."""
    return change(model__head_channels=2 * config.model.head_channels)(config)


def submission(args: Args) -> list[str]:
    """Write the results file of the trained detector; returns lines that say where, or why not."""
    scale, seed = make_scale(args), args.seeds[0] if args.seeds else 0
    if not isinstance(scale, NuScenesLayout) or scale.test_version is None:
        return ["No results file: no --test-version."]
    config = wide(faded(scale.base))
    changes = changes_of(config, scale.base)
    cell = read_cells(args.out / args.scale, scale).get((changes, seed), {})
    if "scores" not in cell:
        return [f'No results file: the row "{_SUBMITTED}" has no scores with seed {seed}.']
    run = args.runs / args.scale / run_name(changes, seed)
    kept = Checkpoints(run / CHECKPOINTS).paths()
    if not kept or int(kept[-1].name) != read_json(run / RUN_SPEC, dict[str, Any])["steps"]:
        return [f"No results file: no finished run in {run}, the cell was trained elsewhere."]
    frames = scale.frames("test", config, scale.test_version)
    file = args.out / args.scale / "submission" / "results_nusc.json"
    write_submission(load_detector(run), frames, file)
    return [f"Results file for {len(frames)} keyframes: {file}, {file.stat().st_size} bytes."]


def figures(args: Args) -> dict[str, Any]:
    """Quote the paper's rows and write the results file."""
    quoted = PAPER["tables"]["table8"]["rows"]
    lines = ["Test set, paper (quoted there from the systems' own papers):", ""]
    rows = [(name, str(row["mAP"]), str(row["NDS"])) for name, row in quoted.items()]
    lines += markdown_table(("method", "mAP", "NDS"), rows)
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
