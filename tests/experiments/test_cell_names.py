"""Result cells keep their names while the configuration grows."""

import dataclasses
import json
from pathlib import Path

import pytest
from study_tables import study_tables

from experiments.changes import change
from experiments.paper_tables import scales
from experiments.paper_tables.__main__ import TABLES
from experiments.paper_tables.cell_names import (
    ADDED,
    FIELDS,
    IGNORED,
    SECTIONS,
    SENSOR_FIELDS,
    cell_name,
    config_of_cell,
    describe_sensor,
)
from fcos_lidar_jax.config import AugmentConfig, Config, CopyPasteConfig, config_to_json
from fcos_lidar_jax.presets import CENTERPOINT_COMPACT, QUICKSTART

CELLS = sorted((Path(__file__).parents[2] / "experiments/results/tables").glob("*/cells/*.json"))


def fields_of(value, path=""):
    """Dotted names of all fields that are no sections."""
    for name, part in vars(value).items():
        yield from fields_of(part, f"{path}{name}.") if dataclasses.is_dataclass(part) else (path + name,)


def test_every_committed_cell_is_named_by_what_it_holds():
    assert CELLS
    for file in CELLS:
        record = json.loads(file.read_text(encoding="utf-8"))
        config = config_of_cell(record["config"])
        assert cell_name(config, record["scale"], record["seed"]) == file.stem
        assert config_of_cell(json.loads(json.dumps(config_to_json(config)))) == config


def test_the_tables_of_today_find_every_committed_cell(tmp_path):
    scale = scales.quarter(tmp_path)
    rows = [row for table in (*TABLES, *study_tables()) for row in table.rows]
    for file in CELLS:
        if file.parts[-3] == scale.name:
            seed = json.loads(file.read_text(encoding="utf-8"))["seed"]
            assert file.stem in {cell_name(row.change(scale.base), scale.describe(), seed) for row in rows}


def test_a_field_of_a_committed_cell_comes_back():
    record = json.loads(CELLS[0].read_text(encoding="utf-8"))["config"]
    config = config_of_cell(record)
    assert config.model.stem.dilations == tuple(record["model"]["stem"]["dilations"])
    assert (config.name, config.max_points) == (record["name"], record["max_points"])
    assert config.augment.scale_range == tuple(record["augment"]["scale_range"])
    with pytest.raises(ValueError, match=r"cell\.projection\.num_rounds: got 'five', expected int"):
        config_of_cell({**record, "projection": {**record["projection"], "num_rounds": "five"}})


def test_every_field_of_the_configuration_is_declared_to_name_cells_or_not():
    whole = Config(augment=AugmentConfig(), copy_paste=CopyPasteConfig())
    missing = set(fields_of(whole)) - (FIELDS | ADDED.keys() | IGNORED | set(SECTIONS))
    assert not missing, f"say in experiments/paper_tables/cell_names.py whether these name a cell: {missing}"


def test_cells_are_told_apart_by_what_decides_them():
    changes = {"model__tied_heads": True, "projection__prioritize_current": False, "copy_paste": None}
    changes |= {"class_ranges_m": (30.0,) * 10, "classes": tuple("abcdefghij")}
    changes |= {"copy_paste__min_points": 6, "augment__scale_range": (0.9, 1.1)}
    configs = [QUICKSTART, *(change(**{field: value})(QUICKSTART) for field, value in changes.items())]
    names = {cell_name(config, {}, seed) for config in configs for seed in (0, 1)}
    assert len(names) == 2 * len(configs) == 16
    assert cell_name(QUICKSTART, {"scale": "elsewhere"}, 0) not in names
    assert cell_name(change(name="other")(QUICKSTART), {}, 0) in names
    by_name, by_count = (change(copy_paste__targets=t)(Config()) for t in ((), Config().paste_targets))
    assert cell_name(by_name, {}, 0) == cell_name(by_count, {}, 0)


def test_a_sensor_is_described_by_its_first_fields_and_by_what_was_added():
    @dataclasses.dataclass(frozen=True)
    class Grown(scales.Sensor):
        added: float = 0.0

    first = {name: getattr(scales.TINY, name) for name in SENSOR_FIELDS}
    grown = Grown(**first)
    assert describe_sensor(grown) == first
    assert describe_sensor(dataclasses.replace(grown, added=1.0)) == {**first, "added": 1.0}


def test_every_choice_of_another_detector_names_a_cell_and_comes_back():
    other = change(pillars__min_radius=3)(CENTERPOINT_COMPACT)
    ours = Config.of(CENTERPOINT_COMPACT)
    names = {cell_name(config, {}, 0) for config in (CENTERPOINT_COMPACT, other, ours)}
    assert len(names) == 3
    assert config_of_cell(json.loads(json.dumps(config_to_json(other)))) == other
