"""Opening data sets: recognition of formats, splits, options of each format, boxes without clouds, errors."""

import dataclasses
import json
import os
import pickle
import shutil
from typing import NamedTuple, get_args

import numpy as np
import pytest
from made_argoverse2 import make_argoverse2
from made_folder import CLASSES, make_folder
from made_kitti import make_kitti
from made_nuscenes import VERSION, make_tables, token, write
from refusal import refused
from toy_frames import toy_frame

from experiments.cached import CachedFrames
from fcos_lidar_jax.classes import ARGOVERSE2_CLASSES, NUSCENES_CLASSES
from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data import kitti
from fcos_lidar_jax.data.argoverse2 import Argoverse2Frames
from fcos_lidar_jax.data.class_mapping import MappedFrames
from fcos_lidar_jax.data.clouds import CloudFiles
from fcos_lidar_jax.data.folder import FolderFrames
from fcos_lidar_jax.data.frame import InMemoryFrames, SelectedFrames
from fcos_lidar_jax.data.kitti import KittiFrames
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.input_pipeline.open import READERS, default_split, find_data_set, open_frames
from fcos_lidar_jax.input_pipeline.open import Format as FormatName
from fcos_lidar_jax.sensors import ARGOVERSE2, NUSCENES_HDL32E, TINY, VLP16, sector
from fcos_lidar_jax.simulation.frame_set import SimulatedFrames

COARSE = dataclasses.replace(ARGOVERSE2, num_columns=128)


class Format(NamedTuple):
    """A data set of a format: its reader, how many frames it and its split have, and a file of its boxes."""

    reader: type
    frames: int
    boxes: str
    split: str = "train"
    in_split: int = 2


FORMATS = {
    "nuscenes": Format(NuScenesFrames, 8, "sample_annotation.json", "scene-1", 4),
    "kitti": Format(KittiFrames, 3, "label_2/000000.txt"),
    "argoverse2": Format(Argoverse2Frames, 4, "annotations.feather"),
    "folder": Format(FolderFrames, 3, "boxes/000.json"),
}


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    """A data set of every format."""
    folder = tmp_path_factory.mktemp("formats")
    return {
        "nuscenes": write(folder / "nuscenes", *make_tables()),
        "kitti": make_kitti(folder / "kitti", train=2, val=1, sensor=TINY),
        "argoverse2": make_argoverse2(folder / "argoverse2", sweeps=2, sensor=COARSE),
        "folder": make_folder(folder / "folder", train=2, val=1),
    }


def test_every_format_is_tried_here(roots):
    assert roots.keys() == FORMATS.keys()
    assert SETS.keys() >= set(get_args(FormatName))
    assert FORMATS.keys() | {"simulated"} == {reader.name for reader in READERS} == set(get_args(FormatName))


@pytest.mark.parametrize("format", FORMATS)
def test_a_format_is_recognised_and_its_frames_are_consistent(roots, format):
    assert find_data_set(roots[format]).reader.name == format
    frames = pickle.loads(pickle.dumps(open_frames(roots[format])))  # as in worker processes
    assert type(frames) is FORMATS[format].reader
    assert len(frames) == FORMATS[format].frames
    for i in range(len(frames)):
        frame = frames.frame(i)
        assert frame.points.shape[1] == frames.sensor.point_columns
        assert (frame.points[:, 4] == 0).all()  # one sweep by default
        assert len(frame.boxes) == len(frame.labels) == len(frame.num_points)
        arrays = frame.points, frame.boxes, frame.labels, frame.num_points
        assert [array.dtype for array in arrays] == ["f4", "f4", "i4", "i4"]
        assert frame.labels.max(initial=0) < len(frames.classes)
        assert frames.name(i)
    assert len({frames.name(i) for i in range(len(frames))}) == len(frames)


@pytest.mark.parametrize("format", FORMATS)
def test_a_split_contains_some_of_the_frames(roots, format):
    whole, part = open_frames(roots[format]), open_frames(roots[format], split=FORMATS[format].split)
    assert len(part) == FORMATS[format].in_split < len(whole)
    assert {part.name(i) for i in range(len(part))} < {whole.name(i) for i in range(len(whole))}


def test_options_are_passed_to_the_readers(roots):
    frames = open_frames(roots["nuscenes"], split="scene-1", reading=CloudReading(3, "none"), sensor=TINY)
    data = NuScenes(roots["nuscenes"], VERSION)
    sample = token("sample", 1, 3)
    np.testing.assert_array_equal(frames.frame(3).points, data.fuse_sweeps(sample, CloudReading(3, "none"))[0])
    np.testing.assert_array_equal(frames.pose(3), data.sensor_to_global(sample))
    assert (frames.sensor, frames.name(3), frames.scene(3)) == (TINY, sample, "scene-1")
    assert frames.time_us(3) == 1_600_000_000_000_000 + 10**8 + 9 * 50_000
    for format in FORMATS:
        readings = CloudReading(1, "all", 6.0), CloudReading(1, "sweeps", 6.0)
        close = [open_frames(roots[format], reading=reading).frame(0) for reading in readings]
        kept, all_of_them = (len(frame.points) for frame in close)
        assert kept + close[0].num_close == all_of_them + close[1].num_close
        assert kept < all_of_them
        sensor = dataclasses.replace(open_frames(roots[format]).sensor, origin_m=(1000.0, 0.0, 0.0))
        far = open_frames(roots[format], reading=readings[0], sensor=sensor).frame(0)
        assert (far.num_close == 0) == (format == "folder")  # the others know where their sensor is


def test_data_keep_their_units_and_axes_with_another_sensor(roots, capsys):
    own = open_frames(roots["kitti"])
    assert not capsys.readouterr().err
    frames, _ = (open_frames(roots["kitti"], sensor=NUSCENES_HDL32E) for _ in range(2))
    (told,) = capsys.readouterr().err.splitlines()  # once
    assert told.endswith("kitti: intensities are scaled by 255, as for all data of format kitti")
    np.testing.assert_array_equal(frames.frame(0).points, own.frame(0).points)  # intensities times 255 too
    assert (frames.sensor.forward_rad, frames.sensor.intensity_scale, frames.sensor.num_rows) == (0, 255, 32)
    # In nuScenes and simulated frames y points forward, and the LiDAR is at the origin.
    elsewhere = {
        "forward_rad": 0.0,
        "origin_m": (1.4, 0.0, 1.6),
        "limit_z_m": (-3.4, 4.6),
        "intensity_scale": 255.0,
    }
    for where in ({"root": roots["nuscenes"]}, {"format": "simulated"}):
        capsys.readouterr()
        frames, _ = (open_frames(**where, sensor=dataclasses.replace(TINY, **elsewhere)) for _ in range(2))
        (told,) = capsys.readouterr().err.splitlines()
        assert "intensities are scaled by 1 and the LiDAR is at (0.0, 0.0, 0.0) m, as for all data of " in told
        assert dataclasses.replace(frames.sensor, limit_z_m=TINY.limit_z_m) == TINY
        assert frames.sensor.limit_z_m == pytest.approx(TINY.limit_z_m)
        expected = open_frames(**where, sensor=TINY).frame(0).points
        np.testing.assert_array_equal(frames.frame(0).points, expected)
        assert open_frames(**where, sensor=VLP16).sensor == dataclasses.replace(VLP16, forward_rad=np.pi / 2)
        ahead = open_frames(**where, sensor=sector(dataclasses.replace(TINY, forward_rad=0.0), 0.0, 64)).sensor
        assert ahead.azimuth_limits_rad == pytest.approx((np.pi / 4, 3 * np.pi / 4))


def test_intensities_are_brought_to_the_scale_of_the_network_by_a_given_factor(roots, tmp_path):
    for format in ("kitti", "argoverse2", "folder"):
        plain, times = open_frames(roots[format]), open_frames(roots[format], intensity_scale=8.0)
        expected = plain.frame(0).points
        expected[:, 3] *= 8 / plain.sensor.intensity_scale
        np.testing.assert_allclose(times.frame(0).points, expected, rtol=1e-6)
        assert times.sensor == dataclasses.replace(plain.sensor, intensity_scale=8.0)
        assert times.fingerprint() != plain.fingerprint()
    root = shutil.copytree(roots["folder"], tmp_path / "folder")
    for file in (root / "clouds").iterdir():
        file.unlink()
        np.full((4, 5), 9, np.float32).tofile(file.with_suffix(".pcd.bin"))
    with refused(".pcd.bin: intensity scale: got 8, expected none"):
        open_frames(root, intensity_scale=8.0)


def test_a_class_map_renames_and_drops_classes(roots):
    frames = open_frames(roots["folder"], class_map={"person": None, "post": "pole"})
    assert frames.classes == ("pole", "vehicle")
    plain = open_frames(roots["folder"])
    assert plain.classes == CLASSES
    for i in range(3):
        own = [plain.classes[label] for label in plain.labels(i)]
        translated = [{"post": "pole"}.get(name, name) for name in own if name != "person"]
        assert [frames.classes[label] for label in frames.labels(i)] == translated
    assert MappedFrames(frames, ("vehicle",)).left_out().keys() == {"pole"}


def test_class_maps_cover_all_classes_and_lead_to_classes_of_the_other_data():
    classes = {"nuscenes": NUSCENES_CLASSES, "kitti": kitti.CLASSES, "argoverse2": ARGOVERSE2_CLASSES}
    for reader in READERS:
        for name, names in reader.class_maps.items():
            assert list(names) == list(classes[reader.name if reader.marks else "nuscenes"])
            assert {new for new in names.values() if new is not None} <= set(classes[name])


@pytest.mark.parametrize("format", FORMATS)
def test_the_fingerprint_depends_on_files_and_options(roots, tmp_path, format):
    root = shutil.copytree(roots[format], tmp_path / "copy")
    same = open_frames(root).fingerprint()
    assert open_frames(root).fingerprint() == same
    if format != "nuscenes":  # its fingerprint is of the index; copying changes the times of other files
        assert open_frames(roots[format]).fingerprint() == same
    changes = ({"split": FORMATS[format].split}, {"reading": CloudReading(1, "all", 2.0)})
    prints = [same, *(open_frames(root, **change).fingerprint() for change in changes)]
    file = next(root.rglob(FORMATS[format].boxes))
    if format == "nuscenes":
        file.write_text(file.read_text().replace('"size": [\n1.5', '"size": [\n1.6'))
    else:
        os.utime(file, (1, 1))
    prints.append(open_frames(root).fingerprint())
    assert len(set(prints)) == 4


BAD = {
    "nothing": ({}, "no known data set, expected one of */sample.json (nuscenes), training/velodyne (kitti)"),
    "gone": ({"root": "gone"}, "gone: no such folder, expected a data set"),
    "format": ({"root": "kitti", "format": "kiti"}, "format: got 'kiti', expected kitti"),
    "version of kitti": ({"root": "kitti", "version": "v1"}, "version: got v1, expected none"),
    "no such version": ({"root": "nuscenes", "version": "v9"}, "version: got v9, expected one of v1.0-made"),
    "full turn": ({"root": "argoverse2", "full_turn": True}, "full_turn: got True, expected none"),
    "no scale": ({"root": "folder", "intensity_scale": -2.0}, "intensity_scale: got -2.0, expected within"),
    "class map": (
        {"root": "kitti", "class_map": {"Lorry": "truck"}},
        "class map: got Lorry, expected classes of the data: Car, Van, ",
    ),
    "map of a folder": (
        {"root": "folder", "class_map": "nuscenes"},
        "class map: got 'nuscenes', expected one of the class maps of format folder: (none)",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_options_that_do_not_fit_are_refused(roots, tmp_path, case):
    options, message = BAD[case]
    root = roots.get(options.get("root"), tmp_path / options.get("root", ""))
    with refused(message):
        open_frames(root, **{name: value for name, value in options.items() if name != "root"})


def test_one_of_several_formats_or_versions_must_be_named(roots, tmp_path):
    root = shutil.copytree(roots["nuscenes"], tmp_path / "both")
    shutil.copytree(root / VERSION, root / "v2")
    with refused("version: got none, expected one of v1.0-made, v2"):
        open_frames(root)
    assert len(open_frames(root, version="v2")) == 8
    (root / "clouds").mkdir()
    with refused("looks like nuscenes and folder, expected one format: name it"):
        open_frames(root, version="v2")
    assert len(open_frames(root, format="nuscenes", version="v2")) == 8


def test_default_splits(roots, tmp_path):
    def split(root, purpose, required=True, **more):
        return default_split(find_data_set(root), purpose, required=required, **more)

    for format in ("kitti", "argoverse2", "folder"):
        assert (split(roots[format], "train"), split(roots[format], "val", required=False)) == ("train", "val")
    root = shutil.copytree(roots["nuscenes"], tmp_path / "nuscenes")
    with refused("got splits all, scene-0, scene-1, none, lost, none is train: name one"):
        split(root, "train")
    assert split(root, "val", required=False) is None
    own = root / VERSION / "splits.json"
    own.write_text('{"only": ["scene-0"]}')
    assert (split(root, "train"), split(root, "val"), split(root, "val", required=False)) == ("only", "only", None)
    own.write_text('{"train": ["scene-0"]}')
    with refused("got splits train, none is val: name one"):
        split(root, "val")  # training frames are evaluated only on request
    assert split(root, "val", required=False) is None
    (tmp_path / "own.json").write_text('{"train": ["scene-1"], "other": []}')
    assert split(root, "train", splits=tmp_path / "own.json") == "train"
    own.unlink()
    assert (split(root, "train"), split(root, "val", required=False)) == ("train", "val")
    (root / VERSION).rename(root / "v1.0-mini")
    assert (split(root, "train"), split(root, "val")) == ("mini_train", "mini_val")
    assert split(root, "train", splits=tmp_path / "own.json") == "train"
    root = shutil.copytree(roots["kitti"], tmp_path / "kitti")
    shutil.rmtree(root / "ImageSets")
    assert (split(root, "train"), split(root, "val")) == (None, None)
    root = shutil.copytree(roots["folder"], tmp_path / "folder")
    (root / "splits.json").unlink()
    assert split(root, "train") is None
    with refused("gone.json: no such file, expected splits"):
        split(root, "train", splits=root / "gone.json")


def folder_with_sweeps(roots, place):
    """The second frame has a list of two sweeps, of which the older one shows the same place."""
    root = shutil.copytree(roots["folder"], place / "folder_with_sweeps")
    older, lists = root / "older", root / "sweeps"
    older.mkdir()
    lists.mkdir()
    shutil.copy(root / "clouds" / "001.npy", older)
    files = ("../clouds/001.npy", 100_000), ("../older/001.npy", 0)
    pose = np.eye(4).tolist()
    sweeps = [{"file": file, "timestamp_us": time_us, "sensor_to_world": pose} for file, time_us in files]
    (lists / "001.json").write_text(json.dumps(sweeps))
    return open_frames(root, num_sweeps=2)


def cached_frames(roots, place):
    frames = CachedFrames(SimulatedFrames(TINY, 2, reading=CloudReading(2)), place)
    frames.frame(0)  # The other one is made when its boxes are requested.
    return frames


def clouds(roots, place):
    root = folder_with_sweeps(roots, place).root
    return CloudFiles((root / "clouds" / "000.npy", root / "sweeps" / "001.json"), TINY, CloudReading(2))


RENAMED = ("cyclist", "person"), {"pedestrian": "person"}
SETS = {  # frames of every kind, from the data sets and an empty folder
    "nuscenes": lambda roots, _: open_frames(roots["nuscenes"], num_sweeps=3),
    "argoverse2": lambda roots, _: open_frames(roots["argoverse2"], num_sweeps=2),
    "kitti": lambda roots, _: open_frames(roots["kitti"]),
    "folder": folder_with_sweeps,
    "simulated": lambda *_: SimulatedFrames(TINY, 2, reading=CloudReading(2)),
    "in memory": lambda *_: InMemoryFrames((toy_frame(0), toy_frame(1)), TINY, ("car",) * 10),
    "mapped": lambda roots, _: MappedFrames(open_frames(roots["nuscenes"], num_sweeps=3), *RENAMED),
    "selected": lambda roots, _: SelectedFrames(open_frames(roots["kitti"]), (2, 0)),
    "cached": cached_frames,
    "clouds": clouds,
}
COUNTED = ("kitti", "folder", "simulated", "selected", "cached")  # from the clouds, by reader or simulation


def assert_truth(found, frame):
    for name in ("boxes", "labels", "num_points"):
        ours, theirs = getattr(found, name), getattr(frame, name)
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    assert found.points.shape == (0, frame.points.shape[1])
    assert found.points.dtype == frame.points.dtype
    assert found.points.base is None
    assert found.num_close == 0


@pytest.mark.parametrize("kind", SETS)
def test_the_truth_has_the_boxes_of_the_frame_without_its_points(roots, tmp_path, kind):
    frames = SETS[kind](roots, tmp_path)
    truths = [frames.truth(index) for index in range(len(frames))]
    assert sum(len(truth.boxes) for truth in truths) > 0 or kind == "clouds"
    for index, truth in enumerate(truths):
        assert_truth(truth, frames.frame(index))
    if kind in COUNTED:
        assert any((truth.num_points > 0).any() for truth in truths)


@pytest.mark.parametrize("kind", ["nuscenes", "argoverse2", "mapped"])
def test_the_truth_is_read_without_the_clouds(roots, tmp_path, kind):
    copies = {name: shutil.copytree(roots[name], tmp_path / name) for name in ("nuscenes", "argoverse2", "folder")}
    frames = SETS[kind](copies, tmp_path)
    expected = [frames.frame(index) for index in range(len(frames))]
    for ending in ("*.bin", "*.npy", "lidar/*.feather"):
        for file in tmp_path.rglob(ending):
            file.unlink()
    with pytest.raises((OSError, ValueError)):
        frames.frame(0)
    for index, frame in enumerate(expected):
        assert_truth(frames.truth(index), frame)


def test_the_truth_of_a_folder_reads_the_current_sweep_only(roots, tmp_path):
    frames = folder_with_sweeps(roots, tmp_path)
    expected = frames.frame(1)
    assert len(np.unique(expected.points[:, 4])) == 2
    (frames.root / "older" / "001.npy").write_bytes(b"no cloud")
    with pytest.raises(ValueError, match="older/001"):
        frames.frame(1)
    assert_truth(frames.truth(1), expected)
