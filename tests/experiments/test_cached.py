"""The cache of frames: made once, bit-identical, recreated if damaged, refused for other frame sets."""

import dataclasses
import multiprocessing
import pickle
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from refusal import refused
from toy_frames import ToyFrames, toy_frame

from experiments.cached import CachedFrames
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.sensors import SHORT_RANGE, TINY
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

FRAMES = SimulatedFrames(TINY, 6, reading=CloudReading(2), fast_traffic=True)


@dataclasses.dataclass(frozen=True)
class Toy(ToyFrames):
    """Small frames that log their indices to a file."""

    size: int = 20
    log: str = ""

    def frame(self, index: int) -> Frame:
        with Path(self.log).open("a") as log:
            log.write(f"{index}\n")
        return dataclasses.replace(toy_frame(index, num_boxes=2, num_points=4), num_close=index)

    def labels(self, index: int) -> np.ndarray:
        return self.frame(index).labels


@pytest.fixture
def toy(tmp_path) -> Toy:
    return Toy(log=str(tmp_path / "log"))


def assert_same(a: Frame, b: Frame) -> None:
    for x, y in zip(vars(a).values(), vars(b).values(), strict=True):
        assert type(x) is type(y)
        assert getattr(x, "dtype", int) == getattr(y, "dtype", int)
        np.testing.assert_array_equal(x, y)


def test_cached_frames_are_bit_identical(tmp_path):
    cached = CachedFrames(FRAMES, tmp_path / "new" / "cache")
    for index in (4, 0) * 2:
        assert_same(cached.frame(index), FRAMES.frame(index))
        np.testing.assert_array_equal(cached.labels(index), FRAMES.labels(index))
    assert (len(cached), cached.name(3), cached.fingerprint()) == (6, FRAMES.name(3), FRAMES.fingerprint())
    assert (cached.classes, cached.sensor) == (FRAMES.classes, TINY)
    assert sorted(p.name for p in cached.folder.iterdir()) == ["000000.npz", "000004.npz", "frames.json"]


def test_only_requested_frames_are_made_and_only_once(tmp_path, toy):
    for _ in range(3):
        cached = CachedFrames(toy, tmp_path / "cache")
        for index in (7, 2, 7):
            assert_same(cached.frame(index), Toy(log=str(tmp_path / "other")).frame(index))
        cached.labels(2)
    assert Path(toy.log).read_text().split() == ["7", "2"]


def test_truncated_and_altered_files_are_recreated(tmp_path, toy, capsys):
    cached, right = CachedFrames(toy, tmp_path / "cache"), toy.frame(5)
    cached.frame(5)
    file = cached.folder / "000005.npz"
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    wrong = [b"", b"no archive", pickle.dumps(right), *(whole[:n] for n in range(1, len(whole), 97))]
    for at in range(0, len(whole), 3):
        wrong.append(whole[:at] + bytes([whole[at] ^ rng.integers(1, 256)]) + whole[at + 1 :])
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
    assert not list(cached.folder.glob(".*"))


def test_a_folder_of_other_frames_is_refused(tmp_path, toy):
    folder = tmp_path / "cache"
    CachedFrames(FRAMES, folder).frame(0)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    others = {
        "reading: found": dataclasses.replace(FRAMES, reading=CloudReading(3)),
        "fast_traffic: found True, expected False": dataclasses.replace(FRAMES, fast_traffic=False),
        "number: found 6, expected 7": dataclasses.replace(FRAMES, number=7),
        "sensor: found tiny, expected short_range": dataclasses.replace(FRAMES, sensor=SHORT_RANGE),
        "kind: found SimulatedFrames, expected Toy": toy,
    }
    for line, other in others.items():
        with refused(f"{folder / 'frames.json'}: {line}"):
            CachedFrames(other, folder)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def read_all(folder: Path, toy: Toy) -> list[Frame]:
    cached = CachedFrames(toy, folder)
    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(cached.frame, range(20)))


def test_threads_and_processes_can_share_a_folder(tmp_path, toy):
    """All of them begin at the same time with an empty folder."""
    folder = tmp_path / "cache"
    context = multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        answers = pool.starmap(read_all, [(folder, toy)] * 4, chunksize=1)
    for answer in answers:
        for index, frame in enumerate(answer):
            assert_same(frame, toy.frame(index))
    assert len(list(folder.iterdir())) == 21
