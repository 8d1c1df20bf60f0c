"""The cache of frames: made once, bit-identical, recreated if damaged, refused for other frame sets."""

import dataclasses
import multiprocessing
import pickle
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from refusal import refused
from toy_frames import ToyFrames, toy_frame

from experiments.cached import CachedFrames
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.sensors import SHORT_RANGE, TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames
from fcos_lidar_jax.simulation.streets import CITY

NOTED: list[int] = []


@dataclasses.dataclass(frozen=True)
class Toy(ToyFrames):
    """Small frames, which note that they were made."""

    size: int = 20

    def frame(self, index: int) -> Frame:
        NOTED.append(index)
        return made(index)


def made(index: int) -> Frame:
    return dataclasses.replace(toy_frame(index, num_boxes=2, num_points=4), num_close=index)


def assert_same(a: Frame, b: Frame) -> None:
    for x, y in zip(vars(a).values(), vars(b).values(), strict=True):
        assert type(x) is type(y)
        assert getattr(x, "dtype", int) == getattr(y, "dtype", int)
        np.testing.assert_array_equal(x, y)


def test_requested_frames_are_made_once_and_come_back_bit_for_bit(tmp_path):
    toy = Toy()
    NOTED.clear()
    for _ in range(3):
        cached = CachedFrames(toy, tmp_path / "new" / "cache")
        for index in (7, 2, 7):
            assert_same(cached.frame(index), made(index))
        np.testing.assert_array_equal(cached.labels(2), made(2).labels[made(2).num_points != 0])
    assert NOTED == [7, 2]
    assert cached.made() == [2, 7]
    assert (len(cached), cached.name(3), cached.fingerprint()) == (20, toy.name(3), toy.fingerprint())
    assert (cached.classes, cached.sensor) == (toy.classes, toy.sensor)


def test_truncated_and_altered_files_are_recreated(tmp_path, capsys):
    cached, right = CachedFrames(Toy(), tmp_path / "cache"), made(5)
    cached.frame(5)
    file = cached.folder / "000005.npz"
    whole = file.read_bytes()
    wrong = [b"", b"no archive", pickle.dumps(right), *(whole[:n] for n in range(1, len(whole), 97))]
    wrong += [whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :] for at in range(0, len(whole), 10)]
    warned = 0
    for content in wrong:
        file.write_bytes(content)
        assert_same(cached.frame(5), right)
        if warning := capsys.readouterr().err:  # some bytes do not matter, such as dates
            assert re.fullmatch(rf"warning: {re.escape(str(file))}: damaged \(.*\): recreating it\n", warning)
            assert_same(cached.frame(5), right)
            assert capsys.readouterr().err == ""
            warned += 1
    assert warned > 0.5 * len(wrong)


def test_a_folder_of_other_frames_is_refused(tmp_path):
    frames, folder = SimulatedFrames(TINY, 6, reading=CloudReading(2)), tmp_path / "cache"
    for _ in range(2):
        CachedFrames(frames, folder)
    changed = {
        "reading": CloudReading(3),
        "fast_traffic": True,
        "number": 7,
        "sensor": SHORT_RANGE,
        "streets": CITY,
    }
    others = {name: dataclasses.replace(frames, **{name: value}) for name, value in changed.items()}
    for name, other in {**others, "kind": Toy()}.items():
        with refused(f"{folder / 'frames.json'}: found frames with another {name}"):
            CachedFrames(other, folder)


def read_all(folder: Path) -> list[Frame]:
    cached = CachedFrames(Toy(), folder)
    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(cached.frame, range(20)))


def test_threads_and_processes_can_share_a_folder(tmp_path):
    folder = tmp_path / "cache"
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        other = pool.starmap_async(read_all, [(folder,)] * 3, chunksize=1)
        answers = [read_all(folder) for _ in range(3)] + other.get()
    for answer in answers:
        for index, frame in enumerate(answer):
            assert_same(frame, made(index))
    assert len(list(folder.iterdir())) == 21
