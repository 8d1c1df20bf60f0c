"""Rounds, sweeps and priority with local geometry: what the rows change, and what is refused."""

import dataclasses
import sys

import jax
import pytest
from pretended import Pretended

from experiments.paper_tables import tables
from experiments.paper_tables.cells import changes_of
from experiments.paper_tables.scales import quarter
from experiments.script import run_script
from experiments.studies import mrv_ablations
from experiments.studies.mrv_ablations import AblationArgs, make_table
from fcos_lidar_jax.models import build_detector


def test_every_row_takes_one_part_away_from_the_network_with_local_geometry(tmp_path):
    scale = quarter(tmp_path)
    whole, *others = (row.change(scale.base) for row in make_table().rows)
    assert not scale.base.model.local_geometry
    assert whole == dataclasses.replace(
        scale.base, model=dataclasses.replace(scale.base.model, local_geometry=True)
    )
    assert (whole.num_sweeps, whole.projection.num_rounds, whole.projection.prioritize_current) == (10, 5, True)
    changed = ["projection.num_rounds=1", "num_sweeps=1", "projection.prioritize_current=false"]
    assert [changes_of(config, whole) for config in others] == changed
    for config in (whole, *others):
        detector = build_detector(config, scale.sensor)
        assert jax.eval_shape(detector.init, jax.random.key(0))["params"]


def test_the_number_of_samples_is_an_option(tmp_path, monkeypatch, capsys):
    scale = Pretended()
    monkeypatch.setattr(tables, "make_scale", lambda _: scale)
    monkeypatch.chdir(tmp_path)
    for words in ([], ["--epochs", "4"]):
        monkeypatch.setattr(sys, "argv", ["ablations", "--seeds", "0", "1", *words])
        with pytest.raises(SystemExit, match="0"):
            run_script(mrv_ablations.main, AblationArgs, None)
    names = {file.name for file in (tmp_path / "outputs" / "tables" / "smoke").glob("*.md")}
    assert names == {"mrv_ablations.md", "mrv_ablations_4_epochs.md"}
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
