"""Rounds, sweeps and priority with local geometry: what the rows change, and what is refused."""

import dataclasses
import sys

import jax
import pytest
from pretended import Pretended

from experiments.changes import change
from experiments.paper_tables import tables
from experiments.paper_tables.cells import changes_of
from experiments.paper_tables.scales import quarter, smoke
from experiments.script import run_script
from experiments.studies import mrv_ablations
from experiments.studies.mrv_ablations import AblationArgs, make_table
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.presets import COMPACT

WHOLE = "five rounds of ten sweeps"
CHANGED = {
    "one round of ten sweeps": "projection.num_rounds=1",
    "without priority": "projection.prioritize_current=false",
    "five rounds of one sweep": "num_sweeps=1",
    "one round of one sweep": "num_sweeps=1, projection.num_rounds=1",
    "five rounds of ten sweeps with round offsets": "model.round_offsets=true",
    "without local geometry": "model.local_geometry=false",
}


@pytest.mark.slow
@pytest.mark.parametrize("make_scale", [quarter, smoke])
def test_every_row_changes_the_named_part_only(tmp_path, make_scale):
    scale = make_scale(tmp_path)
    configs = {row.label: row.change(scale.base) for row in make_table().rows}
    whole = configs.pop(WHOLE)
    assert (whole.num_sweeps, whole.projection.num_rounds, whole.projection.prioritize_current) == (10, 5, True)
    assert {label: changes_of(config, whole) for label, config in configs.items()} == CHANGED
    for config in (whole, *configs.values()):
        assert config.optimizer == whole.optimizer
        detector = build_detector(config, scale.sensor)
        assert jax.eval_shape(detector.init, jax.random.key(0))["params"]


def test_at_scale_sector_the_network_has_the_sizes_of_compact_and_larger_batches(tmp_path):
    scale = quarter(tmp_path)
    whole, base = make_table().rows[0].change(scale.base), scale.base
    sizes = "backbone_blocks", "backbone_widths", "fpn_channels", "head_channels"
    stem = dataclasses.replace(base.model.stem, out_channels=COMPACT.model.stem.out_channels)
    model = {name: getattr(COMPACT.model, name) for name in sizes} | {"stem": stem, "local_geometry": True}
    assert whole.model == dataclasses.replace(base.model, **model)
    assert (whole.optimizer.batch_size, whole.optimizer.epochs) == (4, 4)
    assert whole.optimizer.ema_decay == pytest.approx(base.optimizer.ema_decay**4, abs=1e-4)
    toy = smoke(tmp_path).base
    for table, own in ((make_table(), toy), (make_table(small=True), base)):
        assert table.rows[0].change(own) == change(model__local_geometry=True)(own)


def test_the_number_of_samples_is_an_option(tmp_path, monkeypatch, capsys):
    scale = Pretended()
    monkeypatch.setattr(tables, "make_scale", lambda _: scale)
    monkeypatch.chdir(tmp_path)
    for words in ([], ["--epochs", "4"], ["--small"]):
        monkeypatch.setattr(sys, "argv", ["ablations", "--seeds", "0", "1", *words])
        with pytest.raises(SystemExit, match="0"):
            run_script(mrv_ablations.main, AblationArgs, None)
    names = {file.name for file in (tmp_path / "outputs" / "tables" / "smoke").glob("*.md")}
    assert names == {"mrv_ablations.md", "mrv_ablations_4_epochs.md", "mrv_ablations_small.md"}
    assert "with local geometry, 4 epochs" in capsys.readouterr().out
    epochs = {config.optimizer.epochs for config in (row.change(scale.base) for row in make_table(4).rows)}
    assert epochs == {4}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--epochs", "0"], "--epochs: got 0, expected at least 1"),
        (["--scale", "nuscenes"], "--scale: got nuscenes, expected smoke or sector"),
    ],
)
def test_a_mistake_is_one_line_before_training(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ablations", *options])
    with pytest.raises(SystemExit, match="1"):
        run_script(mrv_ablations.main, AblationArgs, None)
    assert capsys.readouterr().err == f"ablations: error: {message}\n"
    assert list(tmp_path.iterdir()) == []
