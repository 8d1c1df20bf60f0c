"""Copy-paste: counts, room, removed points, current points alone, the end of it."""

import numpy as np
import pytest
from shapely import area, intersection
from toy_frames import ListedFrames, ToyFrames, toy_frame

import oracles
from fcos_lidar_jax.config import CopyPasteConfig
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.object_builder import build_objects
from fcos_lidar_jax.data.pasting import make_paste

SPEC = CopyPasteConfig()


def rectangles(boxes: np.ndarray) -> np.ndarray:
    return np.asarray(oracles.rectangles(boxes))


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    folder = tmp_path_factory.mktemp("objects")
    return build_objects(ToyFrames(40), folder, shards=[("a", range(20)), ("b", range(20, 40))], fingerprint="f")


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("current_only", [False, True])
def test_pasted_objects_fill_up_the_classes_without_overlap(objects, seed, current_only):
    frame = toy_frame(100 + seed)
    paste = make_paste(objects, SPEC, current_only=current_only)(frame, np.random.default_rng(seed))
    present = np.bincount(frame.labels[frame.num_points >= 1], minlength=10)
    after = present + np.bincount(paste.labels, minlength=10)
    assert (after <= np.maximum(present, SPEC.targets)).all()
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
    if current_only:
        originals = [p[p[:, 4] == 0] for p in originals]
        assert not paste.points[:, 4].any()
    else:
        assert paste.points[:, 4].any()
    assert min(map(len, originals)) >= SPEC.min_points
    np.testing.assert_array_equal(paste.points, np.concatenate(originals))
    assert paste.num_points.tolist() == [int((p[:, 4] == 0).sum()) for p in originals]
    assert paste.num_points.min() >= 1
    pasted = paste.boxes.astype(float)
    inside = [any(oracles.inside(p, box) for box in pasted) for p in frame.points[:, :3].astype(float)]
    assert paste.removed.tolist() == np.flatnonzero(inside).tolist()


def test_a_drawn_object_is_pasted_or_has_no_room(objects):
    """On an empty plain, what is left out overlaps something pasted before."""
    none = np.zeros(0, np.int32)
    bare = Frame(np.zeros((1, 5), np.float32), np.zeros((0, 9), np.float32), none, none)
    one_class = CopyPasteConfig(targets=(0, 0, 0, 0, 0, 1000, 0, 0, 0, 0))
    paste = make_paste(objects, one_class, current_only=False)(bare, np.random.default_rng(0))
    usable = objects.table[(objects.table["label"] == 5) & (objects.table["current"] >= 1)]
    assert set(paste.labels) == {5}
    assert 3 < len(paste.boxes) < len(usable)
    pasted = rectangles(paste.boxes)
    for row in usable:
        overlaps = area(intersection(rectangles(row["box"][None])[0], pasted)) > 1e-9
        assert overlaps.any()


def test_what_was_left_out_takes_no_room(tmp_path):
    """Three in a row, of which the middle one overlaps both others: it comes alone, or they come both."""
    boxes = np.zeros((3, 9), np.float32)
    boxes[:, 0], boxes[:, 3:6] = [10, 13, 16], [4, 2, 2]
    points = np.zeros((30, 5), np.float32)
    points[:, 0] = np.repeat([9, 13, 17], 10)
    labels, counts = np.zeros(3, np.int32), np.full(3, 10, np.int32)
    frames = ListedFrames((Frame(points, boxes, labels, counts),))
    objects = build_objects(frames, tmp_path, shards=[("a", (0,))], fingerprint="f")
    paste = make_paste(objects, CopyPasteConfig(targets=(3,) + (0,) * 9), current_only=False)
    empty = Frame(points[:1] + 50, boxes[:0], labels[:0], counts[:0])
    seen = {tuple(sorted(paste(empty, np.random.default_rng(s)).boxes[:, 0])) for s in range(20)}
    assert seen == {(13,), (10, 16)}


def test_full_classes_get_nothing(objects):
    frame = toy_frame(100)
    present = np.bincount(frame.labels[frame.num_points >= 1], minlength=10)
    full = CopyPasteConfig(targets=tuple(present.tolist()))
    paste = make_paste(objects, full, current_only=False)(frame, np.random.default_rng(0))
    assert (paste.points.shape, len(paste.boxes), len(paste.removed)) == ((0, 5), 0, 0)


def test_boxes_without_points_take_room_but_do_not_count(objects):
    frame = toy_frame(100)
    hidden = Frame(frame.points, frame.boxes, frame.labels, np.zeros_like(frame.num_points))
    paste = make_paste(objects, SPEC, current_only=False)(hidden, np.random.default_rng(0))
    boxes = rectangles(frame.boxes)
    assert all(area(intersection(r, boxes)).max() < 1e-9 for r in rectangles(paste.boxes))
    seen = make_paste(objects, SPEC, current_only=False)(frame, np.random.default_rng(0))
    assert len(paste.boxes) > len(seen.boxes)


def test_the_generator_decides(objects):
    paste, frame = make_paste(objects, SPEC, current_only=False), toy_frame(100)
    a, b, c = (paste(frame, np.random.default_rng(s)).boxes for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert a.shape != c.shape or (a != c).any()


def test_objects_of_stale_points_alone_are_not_pasted(tmp_path):
    frame = toy_frame(0)
    stale = frame.points.copy()
    stale[:, 4] = 0.05
    frames = ListedFrames((Frame(stale, frame.boxes, frame.labels, frame.num_points),))
    objects = build_objects(frames, tmp_path, shards=[("a", (0,))], fingerprint="f")
    assert len(objects) > 5
    for current_only in (False, True):
        paste = make_paste(objects, SPEC, current_only=current_only)(toy_frame(100), np.random.default_rng(0))
        assert len(paste.boxes) == 0


def test_a_database_of_larger_objects_is_refused(tmp_path):
    objects = build_objects(ToyFrames(1), tmp_path, shards=[("a", (0,))], fingerprint="f", min_points=9)
    with pytest.raises(ValueError, match=r"copy_paste\.min_points: got 5, .* database's 9"):
        make_paste(objects, SPEC, current_only=False)
