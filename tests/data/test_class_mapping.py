"""Classes mapped by name: what is left out is counted, and nothing in common is refused."""

import numpy as np
import pytest
from refusal import refused

from fcos_lidar_jax.data.class_mapping import MappedFrames, map_labels
from fcos_lidar_jax.data.frame import Frame, InMemoryFrames, SelectedFrames
from fcos_lidar_jax.sensors import TINY

OWN = ("ant", "bee", "cow", "dog")
LABELS = ([0, 2, 1, 2], [3], [])


def make(labels=LABELS) -> InMemoryFrames:
    """Boxes whose values identify their frame and row."""
    frames = []
    for i, own in enumerate(labels):
        boxes = np.arange(len(own) * 9, dtype=np.float32).reshape(-1, 9) + 100 * i
        counts = np.arange(len(own), dtype=np.int32) + 10 * i
        frames.append(
            Frame(np.full((4, 5), i / 10, np.float32), boxes, np.array(own, np.int32), counts, num_close=i)
        )
    return InMemoryFrames(tuple(frames), TINY, OWN)


@pytest.mark.parametrize(
    ("to", "class_map", "expected"),
    [
        (("dog", "ant"), None, [1, -1, -1, 0]),
        (("dog", "ant"), {"cow": "dog", "dog": None}, [1, -1, 0, -1]),
        (("pet",), {"dog": "pet", "ant": "insect"}, [-1, -1, -1, 0]),
    ],
)
def test_labels_are_mapped_by_name(to, class_map, expected):
    assert map_labels(OWN, to, class_map).tolist() == expected


def test_boxes_of_other_classes_are_dropped_and_counted():
    mapped = MappedFrames(make(), ("cow", "elk", "ant"))
    assert (mapped.classes, mapped.sensor, len(mapped)) == (("cow", "elk", "ant"), TINY, 3)
    frame = mapped.frame(0)
    assert (frame.labels.tolist(), mapped.labels(0).tolist()) == ([2, 0, 0], [0, 0])  # the first box is empty
    assert frame.labels.dtype == np.int32
    assert (frame.boxes[:, 0].tolist(), frame.num_points.tolist()) == ([0, 9, 27], [0, 1, 3])
    np.testing.assert_array_equal(frame.others, make().frame(0).boxes[2:3])
    assert (len(mapped.frame(1).boxes), mapped.frame(1).num_close, len(mapped.frame(1).points)) == (0, 1, 4)
    assert mapped.left_out() == {"bee": 1, "dog": 1}
    assert MappedFrames(make(), ("dog", "cow", "bee", "ant")).left_out() == {}


def test_disjoint_classes_and_unknown_names_are_refused():
    with refused("have ant, bee, cow, dog, the detector car, bus, expected a name"):
        MappedFrames(make(), ("car", "bus"))
    with refused("expected a name in both"):
        MappedFrames(make(), ("ant",), {"ant": None})
    with refused("class map: got yak, zebra, expected classes of the data: ant, bee"):
        map_labels(("ant", "bee"), ("ant",), {"yak": "ant", "bee": "ant", "zebra": None})


def test_the_fingerprint_depends_on_the_mapping_unless_it_changes_nothing():
    frames = make()
    others = [(OWN, {"ant": "bee"}), (OWN, {"ant": None}), (("bee", "ant", "cow", "dog"),), (OWN[:3],)]
    prints = [MappedFrames(frames, *other).fingerprint() for other in [*others, ((*OWN, "elk"),), (OWN,)]]
    assert prints[-1] == frames.fingerprint()
    assert len(set(prints)) == 6


class Placed(InMemoryFrames):
    """Frames with poses, times and scenes."""

    def pose(self, index: int) -> np.ndarray:
        return np.eye(4) * index

    def time_us(self, index: int) -> int:
        return 100 * index

    def scene(self, index: int) -> str:
        return f"drive {index}"


def test_wrapped_frames_keep_pose_time_scene_and_name():
    placed = Placed(make(([0], [0], [0])).frames, TINY, ("ant",))
    frames = SelectedFrames(MappedFrames(placed, ("bee", "ant")), (2, 1))
    assert (len(frames), frames.classes, frames.sensor) == (2, ("bee", "ant"), TINY)
    np.testing.assert_array_equal(frames.pose(0), 2 * np.eye(4))
    assert (frames.time_us(0), frames.scene(0), frames.name(0)) == (200, "drive 2", "frame 2")
    assert (frames.frame(0).num_close, frames.labels(1).tolist(), frames.name(1)) == (2, [1], "frame 1")
    other = SelectedFrames(frames.frames, (1, 2)).fingerprint()
    assert len({frames.fingerprint(), other, frames.frames.fingerprint()}) == 3
    plain = make()
    assert (plain.pose(0), plain.time_us(0), plain.scene(0)) == (None, None, "")


def test_the_fingerprint_of_frames_in_memory_depends_on_their_content():
    prints = [make(labels).fingerprint() for labels in (LABELS, ([0, 2, 1, 2], [3], [1]), LABELS[:2], LABELS)]
    assert (len(set(prints)), prints[-1]) == (3, prints[0])
