"""Copy-paste: counts, overlaps, removed points, sweeps, classes by name."""

import dataclasses

import numpy as np
import oracles
import pytest
from refusal import refused
from shapely import area, intersection
from toy_frames import ListedFrames, SceneFrames, ToyFrames, toy_frame

from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.frame import Frame, InMemoryFrames
from fcos_lidar_jax.input_pipeline.copy_paste import make_paste
from fcos_lidar_jax.input_pipeline.database import MAX_SWEEPS, prepare_database
from fcos_lidar_jax.presets import NUSCENES
from fcos_lidar_jax.sensors import NUSCENES_HDL32E

SPEC = CopyPasteConfig()
TOY_LAGS = np.array([0, 0.05, 0.1], np.float32)


def pasted_into(frame, objects, *, seed=0, targets=(), min_points=SPEC.min_points, **options):
    """What is pasted into a frame, and the rows that it removes; arguments as in :class:`CopyPasteConfig`."""
    spec = CopyPasteConfig(targets=targets, min_points=min_points)
    config = dataclasses.replace(NUSCENES, copy_paste=spec, **{"num_sweeps": 10, **options})
    return make_paste(objects, config)(frame, np.random.default_rng(seed))


def without_boxes(frame):
    return Frame(frame.points, frame.boxes[:0], frame.labels[:0], frame.num_points[:0])


def rectangles(boxes: np.ndarray) -> np.ndarray:
    return np.asarray(oracles.rectangles(boxes))


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    frames = SceneFrames(ToyFrames(40), (("a", tuple(range(20))), ("b", tuple(range(20, 40)))))
    return prepare_database(frames, tmp_path_factory.mktemp("objects"))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("num_sweeps", [1, 2, 10])
def test_pasted_objects_fill_up_the_classes_without_overlap(objects, seed, num_sweeps):
    frame = toy_frame(100 + seed)
    paste, removed = pasted_into(frame, objects, seed=seed, num_sweeps=num_sweeps)
    present = np.bincount(frame.labels[frame.num_points >= 1], minlength=10)
    after = present + np.bincount(paste.labels, minlength=10)
    assert (after <= np.maximum(present, NUSCENES.paste_targets)).all()
    assert len(paste.boxes) > 5
    everything = rectangles(np.concatenate([frame.boxes, paste.boxes]))
    for i in range(len(frame.boxes), len(everything)):
        shared = area(intersection(everything[i], np.delete(everything, i)))
        assert shared.max() < 1e-9
    key = {tuple(row["box"][:7].tolist()): i for i, row in enumerate(objects.table)}
    assert np.isnan(paste.boxes[:, 7:]).any()
    sources = [key[tuple(box[:7].tolist())] for box in paste.boxes]
    assert len(set(sources)) == len(sources)
    originals = [objects.points(i) for i in sources]
    newest = TOY_LAGS[:num_sweeps]
    originals = [p[np.isin(p[:, 4], newest)] for p in originals]
    assert np.unique(paste.points[:, 4]).tolist() == newest.tolist()
    assert min(map(len, originals)) >= SPEC.min_points
    np.testing.assert_array_equal(paste.points, np.concatenate(originals))
    assert paste.num_points.tolist() == [int((p[:, 4] == 0).sum()) for p in originals]
    assert paste.num_points.min() >= 1
    pasted = paste.boxes.astype(float)
    inside = [any(oracles.inside(p, box) for box in pasted) for p in frame.points[:, :3].astype(float)]
    assert removed.tolist() == np.flatnonzero(inside).tolist()


def test_nothing_is_pasted_onto_objects_of_other_classes(objects):
    frame = toy_frame(100)
    pasted, _ = pasted_into(frame, objects)
    others = dataclasses.replace(frame, others=pasted.boxes[:1])
    again, _ = pasted_into(others, objects)
    assert [tuple(box[:7]) for box in again.boxes].count(tuple(pasted.boxes[0, :7])) == 0
    assert len(again.boxes) > 0


def test_numbers_of_lasers_are_left_out_if_the_frame_has_none(tmp_path):
    sensor = dataclasses.replace(NUSCENES_HDL32E, row_source="laser")
    frames = InMemoryFrames(tuple(wide(toy_frame(seed)) for seed in range(20)), sensor, NUSCENES_CLASSES)
    found, _ = pasted_into(toy_frame(100), prepare_database(frames, tmp_path))
    assert len(found.boxes) > 5
    assert found.points.shape[1] == 5


def wide(frame):
    return dataclasses.replace(frame, points=np.pad(frame.points, ((0, 0), (0, 1))))


def test_a_sampled_object_is_dropped_only_if_it_overlaps_another(objects):
    """In a frame without boxes, every dropped object overlaps an object that was pasted."""
    paste, _ = pasted_into(without_boxes(toy_frame(0)), objects, targets=(0,) * 5 + (1000,) + (0,) * 4)
    usable = objects.table[(objects.table["label"] == 5) & (objects.num_points(1) >= 1)]
    assert set(paste.labels) == {5}
    assert 3 < len(paste.boxes) < len(usable)
    pasted = rectangles(paste.boxes)
    for row in usable:
        overlaps = area(intersection(rectangles(row["box"][None])[0], pasted)) > 1e-9
        assert overlaps.any()


def test_a_dropped_object_does_not_exclude_others(tmp_path):
    """Three in a row: either the middle one is pasted, which overlaps both others, or both others are."""
    boxes = np.zeros((3, 9), np.float32)
    boxes[:, 0], boxes[:, 3:6] = [10, 13, 16], [4, 2, 2]
    points = np.zeros((30, 5), np.float32)
    points[:, 0] = np.repeat([9, 13, 17], 10)
    frame = Frame(points, boxes, np.zeros(3, np.int32), np.full(3, 10, np.int32))
    objects, targets = prepare_database(ListedFrames((frame,)), tmp_path), (3,) + (0,) * 9
    pasted = [pasted_into(without_boxes(frame), objects, seed=seed, targets=targets)[0] for seed in range(20)]
    assert {tuple(sorted(paste.boxes[:, 0])) for paste in pasted} == {(13,), (10, 16)}


def test_boxes_without_points_exclude_overlaps_but_do_not_count(objects):
    frame = toy_frame(100)
    paste, _ = pasted_into(dataclasses.replace(frame, num_points=np.zeros_like(frame.num_points)), objects)
    boxes = rectangles(frame.boxes)
    assert all(area(intersection(r, boxes)).max() < 1e-9 for r in rectangles(paste.boxes))
    seen, _ = pasted_into(frame, objects)
    assert len(paste.boxes) > len(seen.boxes)


def test_objects_without_points_of_the_current_sweep_are_not_pasted(tmp_path):
    frame = toy_frame(0)
    frame.points[:, 4] = 0.05
    objects = prepare_database(ListedFrames((frame,)), tmp_path)
    assert len(objects) > 5
    for num_sweeps in (1, 2, 10):
        assert len(pasted_into(toy_frame(100), objects, num_sweeps=num_sweeps)[0].boxes) == 0


@pytest.fixture(scope="module")
def long_frame():
    """A frame of 24 sweeps in any order, with boxes far apart of 6 to 300 points."""
    rng = np.random.default_rng(0)
    boxes = np.zeros((12, 9), np.float32)
    boxes[:, 0], boxes[:, 1] = np.tile([-30, -10, 10, 30], 3), np.repeat([-20, 0, 20], 4)
    boxes[:, 3:6], boxes[:, 6] = [4, 2, 2], rng.uniform(-3, 3, 12)
    points = np.repeat(boxes[:, :5], [6, 24, 30, 48, 60, 90, 120, 150, 180, 200, 240, 300], axis=0)
    points[:, :3] += rng.uniform(-0.9, 0.9, (len(points), 3))
    points[:, 4] = rng.choice(np.arange(24, dtype=np.float32) / 20, len(points))
    order = rng.permutation(len(points))
    return Frame(points[order], boxes, np.arange(12, dtype=np.int32) % 10, np.ones(12, np.int32))


@pytest.mark.parametrize("num_sweeps", [1, 3, MAX_SWEEPS])
def test_a_model_of_k_sweeps_gets_the_points_of_the_newest_k(tmp_path, long_frame, num_sweeps):
    """The objects equal those cut from frames of k sweeps, without a point of an older sweep."""
    objects = prepare_database(ListedFrames((long_frame,)), tmp_path)
    paste, _ = pasted_into(without_boxes(long_frame), objects, targets=(100,) * 10, num_sweeps=num_sweeps)
    newest = long_frame.points[long_frame.points[:, 4] < (num_sweeps - 0.5) / 20]
    cut = {}
    for box in long_frame.boxes:
        inside = np.array([oracles.inside(p[:3].astype(float), box.astype(float)) for p in newest])
        cut[box[:7].tobytes()] = newest[inside]
    enough = {box for box, points in cut.items() if len(points) >= 5 and (points[:, 4] == 0).any()}
    originals = [cut[box[:7].tobytes()] for box in paste.boxes]
    assert sorted(map(len, originals)) == sorted(len(cut[box]) for box in enough) != []
    assert paste.num_points.tolist() == [(points[:, 4] == 0).sum() for points in originals]
    expected = np.concatenate([points[np.argsort(points[:, 4], kind="stable")] for points in originals])
    np.testing.assert_array_equal(paste.points, expected)


def test_classes_are_matched_by_name(objects):
    """The database has the ten classes; a detector of three, one of them its own, gets objects of two."""
    classes = ("pedestrian", "tram", "car")
    paste, _ = pasted_into(without_boxes(toy_frame(0)), objects, targets=(50, 50, 50), classes=classes)
    label_of = {row["box"][:7].tobytes(): objects.manifest.classes[row["label"]] for row in objects.table}
    names = [label_of[box[:7].tobytes()] for box in paste.boxes]
    assert set(names) == {"pedestrian", "car"}
    assert [classes[label] for label in paste.labels] == names


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_sweeps": 21}, "num_sweeps: got 21, expected at most the 20 of "),
        ({"targets": (1, 1), "classes": ("tram", "boat")}, "barrier, expected some of tram, boat"),
        ({"min_points": 4}, "copy_paste.min_points: got 4, expected at least the database's 5"),
    ],
    ids=["sweeps", "classes", "points"],
)
def test_a_database_that_does_not_fit_the_configuration_is_refused(objects, options, message):
    with refused(message):
        pasted_into(toy_frame(0), objects, **options)
