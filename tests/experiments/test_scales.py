"""What the cells of each scale are trained and evaluated on."""

import dataclasses
import re

import numpy as np
import pytest
import tyro
from refusal import refused

from experiments.changes import change
from experiments.paper_tables import scales
from experiments.paper_tables.__main__ import TablesArgs
from experiments.paper_tables.paper_rows import PAPER_TABLES
from experiments.paper_tables.scales import NuScenesLayout, quarter, smoke
from fcos_lidar_jax.cli import _explain, prepare
from fcos_lidar_jax.cli.data import DataOptions
from fcos_lidar_jax.evaluation.results import write_results
from fcos_lidar_jax.sensors import NUSCENES_HDL32E, TINY
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import DatasetSpec
from fcos_lidar_jax.simulation.streets import PLAIN
from fcos_lidar_jax.training import Schedule


def test_the_options_of_the_advice_about_memory_are_known():
    values = {"optimizer.accumulate": ["4"], "model.precision": ["bfloat16"], "model.remat": []}
    advised = re.findall(r"--((?:optimizer|model)[\w.]+)", str(_explain(MemoryError())))
    words = [word for name in advised for word in (f"--{name}", *values[name])]
    given = tyro.cli(TablesArgs, args=words).nuscenes
    assert (given.accumulate, given.precision, given.remat) == (4, "bfloat16", True)


def test_one_sweep_and_ten_see_the_same_streets(tmp_path):
    scale = smoke(tmp_path)
    three, ten = (scale.frames("test", n).frame(0) for n in (3, 10))
    np.testing.assert_array_equal(three.boxes, ten.boxes)
    np.testing.assert_array_equal(three.labels, ten.labels)
    lags = np.unique(ten.points[:, 4])
    assert len(lags) == 10
    np.testing.assert_array_equal(three.points, ten.points[ten.points[:, 4] <= lags[2]])


def test_the_sector_is_a_quarter_of_the_sensor_at_its_resolution(tmp_path):
    scale = quarter(tmp_path)
    assert scale.sensor.column_rad == pytest.approx(NUSCENES_HDL32E.column_rad)
    assert (scale.sensor.num_rows, scale.sensor.num_columns) == (32, 272)
    assert scale.describe()["streets"]["name"] == "city"
    for table in PAPER_TABLES[:6]:
        for row in table.rows:
            scale.check(row.change(scale.base))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"num_sweeps": 11}, "num_sweeps: got 11, expected 1 to 10"),
        ({"sensor": "kitti_hdl64e"}, "sensor: got 'kitti_hdl64e'"),
        ({"projection__close_m": 2.0}, "projection.close_m: got 2.0, expected 2.1"),
    ],
)
def test_a_simulated_row_that_would_change_nothing_is_refused(tmp_path, fields, message):
    scale = smoke(tmp_path)
    scale.check(scale.base)
    with pytest.raises(ValueError, match=re.escape(message)):
        scale.check(change(**fields)(scale.base))


@pytest.fixture
def layout(tmp_path) -> NuScenesLayout:
    """A prepared data set with a split for each purpose, and another one of the same version in ``two``."""
    splits = tmp_path / "splits.json"
    splits.write_text('{"mini_train": ["scene-0001"], "mini_val": ["scene-0002"]}')
    spec = DatasetSpec(2, 1, 2, dataclasses.replace(TINY, name="toy", num_columns=64), False, "v1.0-mini", PLAIN)
    for root, seed in (("one", 1), ("two", 2)):
        write_dataset(dataclasses.replace(spec, seed=seed), tmp_path / root, workers=1, report=lambda _: None)
        prepare.run(prepare.Prepare(DataOptions(tmp_path / root, version="v1.0-mini", splits=splits)))
    options = {"steps": 5, "accumulate": 4, "workers": 2, "precision": "bfloat16"}
    options |= {"batch_size": 8, "learning_rate": 0.02, "remat": True}
    return NuScenesLayout(tmp_path / "one", splits=splits, **options)


@pytest.mark.slow
def test_the_full_scale_trains_on_one_split_and_evaluates_on_the_other(layout, tmp_path, monkeypatch):
    asked, submitted = [], []

    def trained(folder, config, frames, **options):
        asked.append((folder, config, frames, options))
        return "the detector"

    def write_submission(detector, frames, file):
        submitted.append((detector, frames))
        file.parent.mkdir(parents=True)
        write_results(file, [(token, b"[]") for token in frames.tokens])

    monkeypatch.setattr(scales, "trained", trained)
    monkeypatch.setattr(scales, "write_submission", write_submission)
    scale = layout.checked()
    assert (scale.version, scale.train_split, scale.val_split) == ("v1.0-mini", "mini_train", "mini_val")
    optimizer, model = scale.base.optimizer, scale.base.model
    assert (optimizer.batch_size, optimizer.accumulate, optimizer.peak_learning_rate) == (8, 4, 0.02)
    assert (model.precision, model.remat) == ("bfloat16", True)
    config = change(num_sweeps=3)(scale.base)
    scores = scale.score(config, 3, tmp_path / "run")
    assert (scores["mAP"], set(scores["AP"].values())) == (0, {0})
    ((folder, wanted, frames, options),), ((detector, tests),) = asked, submitted
    assert (folder, wanted, detector) == (tmp_path / "run", config, "the detector")
    assert (options["steps"], options["seed"], options["workers"]) == (5, 3, 2)
    assert (options["threads"], options["schedule"]) == (None, Schedule()), "as of fcos-lidar train"
    assert ({frames.scene(i) for i in range(2)}, {tests.scene(i) for i in range(2)}) == (
        {"scene-0001"},
        {"scene-0002"},
    )
    assert (frames.reading.num_sweeps, tests.reading.num_sweeps) == (3, 3)
    assert len(options["objects"]) > 0, "those that prepare has cut from ten sweeps"
    # Another data set of the same version is another scale, and has other objects.
    other = dataclasses.replace(layout, data_root=tmp_path / "two").checked()
    assert other.describe()["fingerprints"] != scale.describe()["fingerprints"]
    with refused("built from other data"):
        other.objects(frames)


@pytest.mark.slow
def test_splits_are_opened_before_the_first_cell_is_trained(layout):
    with refused("wrong"):
        dataclasses.replace(layout, val_split="wrong").checked()
    with refused("--test-version: ", "v9/scene.json: no such file"):
        dataclasses.replace(layout, test_version="v9").checked()
    testing = dataclasses.replace(layout, test_version="v1.0-mini")
    with refused("--test-version: split 'test': not found in "):
        testing.checked()
    layout.splits.write_text(layout.splits.read_text().replace("}", ', "test": ["scene-0002"]}'))
    assert testing.checked().test_version == "v1.0-mini"
