"""KITTI object detection: Velodyne clouds with labels in camera coordinates."""

from pathlib import Path

import numpy as np

from fcos_lidar_jax.config import CloudReading
from fcos_lidar_jax.data.box_geometry import check_boxes, count_inside
from fcos_lidar_jax.data.frame import Frame, FrameSet, drop_close, files_fingerprint
from fcos_lidar_jax.data.point_files import read_points
from fcos_lidar_jax.data.recorded import usual_sensor
from fcos_lidar_jax.data.splits import distinct_names
from fcos_lidar_jax.data.text_files import read_lines, read_matrices, read_number
from fcos_lidar_jax.fields import check, check_name
from fcos_lidar_jax.files import expect_file, some_files
from fcos_lidar_jax.progress import tell
from fcos_lidar_jax.sensors import KITTI_HDL64E, Sensor

CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
"""KITTI's object types. ``DontCare`` marks image areas and is not an object."""

TO_NUSCENES = {
    "Car": "car",
    "Van": "car",
    "Truck": "truck",
    "Pedestrian": "pedestrian",
    "Person_sitting": "pedestrian",
    "Cyclist": "bicycle",
    "Tram": "bus",
    "Misc": None,
}
"""Class map from KITTI's types to the ten nuScenes classes; None drops the object. In nuScenes a car may be a van,
a bicycle includes its rider and a pedestrian may sit; a tram has no class and looks most like a bus."""

IMAGE_SIZE = (1242, 375)
"""Width and height of KITTI's left colour image in pixels; some drives have up to 18 columns and 5 rows less."""

_FIELDS = (
    *("truncated", "occluded", "alpha", "left", "top", "right", "bottom"),
    *("height", "width", "length", "x", "y", "z", "rotation_y", "score"),
)
_TYPES = {name.lower(): name for name in (*CLASSES, "DontCare")}
_MAX_TILT_DEG = 25  # of a camera against the Velodyne; KITTI's has about one
_SHAPES = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}


class KittiFrames(FrameSet):
    """The frames of KITTI's ``training`` folder: a :class:`~fcos_lidar_jax.data.frame.FrameSet`.

    Reads ``training/velodyne/NAME.bin``, ``training/label_2/NAME.txt`` and ``training/calib/NAME.txt``. Points
    stay in the Velodyne's frame (x forward, y left, z up; nuScenes has x right, y forward). Boxes are transformed
    to that frame: gravity centre, yaw counter-clockwise from +x. KITTI's boxes are upright for the camera; its
    tilt against the Velodyne, about a degree, is lost. Velocities are unknown: NaN. Labels index :data:`CLASSES`.

    The labels lack the number of points in a box, so :meth:`truth` reads the cloud and counts them.

    Only objects in the left colour image are labelled. Points outside the image are dropped; otherwise a detector
    would learn that everything behind the car is background.

    Args:
        split: take the frames and their order from ``ImageSets/SPLIT.txt``, one name per line; default: all
            frames, sorted.
        full_turn: keep the points outside the image.
        reading: which points on the ego vehicle are dropped; a frame is one sweep.
    """

    classes = CLASSES

    def __init__(
        self,
        root: str | Path,
        split: str | None = None,
        *,
        sensor: Sensor = KITTI_HDL64E,
        full_turn: bool = False,
        reading: CloudReading = CloudReading(),
    ) -> None:
        self.root, self.sensor, self.reading = Path(root), sensor, reading
        self.image_size = None if full_turn else IMAGE_SIZE
        clouds = _stems(self.root / "training" / "velodyne", ".bin")
        self.names = tuple(sorted(clouds)) if split is None else _read_split(self.root, split, clouds)
        """Names of the frames: file names without extension."""
        for kind in ("label_2", "calib"):
            present = _stems(self.root / "training" / kind, ".txt")
            for name in self.names:
                if name not in present:
                    raise ValueError(f"{self._file(kind, name)}: no such file, expected one for every cloud")

    def __len__(self) -> int:
        return len(self.names)

    def frame(self, index: int) -> Frame:
        """Read one frame and count the points in each box."""
        name = self.names[index]
        calibration = read_calibration(self._file("calib", name))
        camera_boxes, labels = read_labels(self._file("label_2", name))
        boxes = to_lidar(camera_boxes, calibration["velo_to_rect"])
        check_boxes(boxes, lambda i: f"{self._file('calib', name)}: takes box {i} of the labels far away")
        boxes = boxes.astype(np.float32)
        points = read_points(self._file("velodyne", name), self.sensor)
        if self.image_size is not None:
            points = points[_in_left_image(points, calibration, self._file("calib", name))]
        points, num_close = drop_close(points, self.sensor, self.reading)
        return Frame(points, boxes, labels, count_inside(points, boxes), num_close)

    def labels(self, index: int) -> np.ndarray:
        return read_labels(self._file("label_2", self.names[index]))[1]

    def name(self, index: int) -> str:
        return self.names[index]

    def camera(self, index: int) -> tuple[Path, np.ndarray] | None:
        """The left colour image, ``training/image_2/NAME.png``, if there is one."""
        image = self.root / "training" / "image_2" / f"{self.names[index]}.png"
        calibration = read_calibration(self._file("calib", self.names[index]))
        return (image, calibration["P2"] @ calibration["velo_to_rect"]) if image.is_file() else None

    def fingerprint(self) -> str:
        files = (self._file(kind, name) for kind in ("velodyne", "label_2", "calib") for name in self.names)
        reading = self.names, self.sensor, self.image_size, self.reading.remove_close, self.reading.close_m
        return files_fingerprint(files, self.root, reading)

    def _file(self, kind: str, name: str) -> Path:
        return self.root / "training" / kind / (name + (".bin" if kind == "velodyne" else ".txt"))


def to_lidar(camera_boxes: np.ndarray, velo_to_rect: np.ndarray) -> np.ndarray:
    """Transform labels in rectified camera coordinates to boxes f64[m, 9] in the Velodyne's frame.

    The camera looks along z, with x right and y down. A label's ``location`` is the centre of its bottom face. At
    ``rotation_y`` zero the object heads along x; it rotates about y.

    Args:
        camera_boxes: f64[m, 7]: ``height, width, length, x, y, z, rotation_y``, metres and radians.
        velo_to_rect: f64[4, 4], from Velodyne to rectified camera coordinates.

    >>> axes = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    >>> ahead = np.array([[1.5, 1.6, 4.0, 2.0, 1.7, 20.0, -np.pi / 2]])  # driving off on the right
    >>> (to_lidar(ahead, axes)[0].round(2) + 0).tolist()
    [20.0, -2.0, -0.95, 4.0, 1.6, 1.5, 0.0, nan, nan]
    """
    height, width, length, x, y, z, turn = camera_boxes.T
    rect_to_velo = np.linalg.inv(velo_to_rect)
    centre = np.stack([x, y - height / 2, z], -1) @ rect_to_velo[:3, :3].T + rect_to_velo[:3, 3]
    heading = np.stack([np.cos(turn), np.zeros_like(turn), -np.sin(turn)], -1) @ rect_to_velo[:3, :3].T
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    unknown = np.full((len(camera_boxes), 2), np.nan)
    return np.concatenate([centre, np.stack([length, width, height, yaw], -1), unknown], -1)


def in_image(points: np.ndarray, velo_to_image: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Which points lie in front of the camera and inside its image, bool[n].

    Args:
        points: f32[n, >= 3] in the Velodyne's frame, metres.
        velo_to_image: f64[3, 4], to homogeneous pixels.
        image_size: width and height, pixels.

    >>> look_along_x = np.array([[50, -100.0, 0, 0], [50, 0, -100, 0], [1, 0, 0, 0]])
    >>> in_image(np.array([[10, 0, 0], [-10, 0, 0], [10, 6, 0]], np.float32), look_along_x, (100, 100)).tolist()
    [True, False, False]
    """
    width, height = image_size
    with np.errstate(invalid="ignore"):  # non-finite points are outside
        u, v, depth = velo_to_image[:, :3] @ points[:, :3].T.astype(np.float64) + velo_to_image[:, 3:]
    # No division by the depth, which may be zero; 0 <= u < width * depth holds only in front of the camera.
    return (u >= 0) & (u < width * depth) & (v >= 0) & (v < height * depth)


def in_camera(file: Path, points: np.ndarray) -> np.ndarray:
    """The points of a file in KITTI's folders inside the left colour image, as in :class:`KittiFrames`.

    Files elsewhere, or without ``calib/NAME.txt`` beside the folder, keep all points. Otherwise a note is
    printed, once per folder.
    """
    calibration = camera_calibration(file)
    if calibration is None:
        return points
    matrices = read_calibration(calibration)
    tell(cropped(file.parent), once=True)
    return points[_in_left_image(points, matrices, calibration)]


def _in_left_image(points: np.ndarray, calibration: dict[str, np.ndarray], file: Path) -> np.ndarray:
    """:func:`in_image` for KITTI's left colour camera; the calibration of another camera is refused."""
    centre, size = calibration["P2"][:2, 2], np.array(IMAGE_SIZE)
    if (np.abs(centre - size / 2) > size / 10).any():
        found = f"got a principal point of {centre.round().tolist()}, expected one near the middle of {IMAGE_SIZE}"
        raise ValueError(f"{file}: P2: {found} pixels, KITTI's image; --full-turn keeps all points")
    return in_image(points, calibration["P2"] @ calibration["velo_to_rect"], IMAGE_SIZE)


def cropped(folder: Path) -> str:
    """A line about the points of a folder that :func:`in_camera` or :class:`KittiFrames` leaves out."""
    kept = "--full-turn keeps them, which detectors of full turns, such as hdl32e, need"
    return f"{folder}: points outside the camera image are left out; {kept}"


def camera_calibration(file: Path) -> Path | None:
    """The calibration by which :func:`in_camera` crops a file, or None.

    Raises:
        ValueError: the calibrations of other files are there; a mixture of crops and full turns would be scored.
    """
    calibration = file.absolute().parent.parent / "calib" / f"{file.stem}.txt"
    if usual_sensor(file) != KITTI_HDL64E or not calibration.parent.is_dir():
        return None
    expect_file(calibration, f"the calibration of {file} (or --full-turn)")
    return calibration


def read_labels(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read boxes f64[m, 7] for :func:`to_lidar` and labels i32[m], which index :data:`CLASSES`."""
    types, fields = read_objects(file)
    kept = [i for i, name in enumerate(types) if name != "DontCare"]
    return fields[kept, 7:14], np.array([CLASSES.index(types[i]) for i in kept], np.int32)


def read_objects(file: Path, *, scored: bool = False) -> tuple[list[str], np.ndarray]:
    """All lines of a label or result file, DontCare too: types, and the numbers that follow them, f64[m, 15].

    The columns are truncation, occlusion, alpha, left, top, right, bottom, height, width, length, x, y, z,
    rotation_y and score; the score is NaN where the line has none. Types in any case become KITTI's.

    Result files (``scored``) need scores, and are read as by the development kit: other types stay as they are;
    height to rotation_y of lines with a box in the image only, without a size or a position, are NaN.
    """
    lengths, expected = ((16,), "16, the score last") if scored else ((15, 16), "15, or 16 with a score")
    types, rows, places = [], [], []
    for where, words in read_lines(file):
        if len(words) not in lengths:
            raise ValueError(f"{where}: got {len(words)} values, expected {expected}")
        kind = _TYPES.get(words[0].lower(), words[0])
        if not scored and kind != "DontCare":
            check_name(f"{where}: type", kind, CLASSES)
        named = zip(_FIELDS, words[1:], strict=False)
        rows.append([read_number(word, f"{where}: {name}") for name, word in named])
        rows[-1] += [np.nan] * (16 - len(words))
        types.append(kind)
        places.append(where)
    fields = np.array(rows, np.float64).reshape(-1, 15)
    if scored:
        flat = (fields[:, 7:10] <= 0).any(axis=1) | (fields[:, 10:13] == -1000).any(axis=1)
        fields[flat, 7:14] = np.nan
    objects = np.flatnonzero(np.isin(types, CLASSES) & ~np.isnan(fields[:, 7]))
    boxes = np.pad(fields[objects][:, [10, 11, 12, 9, 8, 7, 13]], ((0, 0), (0, 2)), constant_values=np.nan)
    check_boxes(boxes, lambda i: places[objects[i]])
    return types, fields


def read_calibration(file: Path) -> dict[str, np.ndarray]:
    """Read ``velo_to_rect`` f64[4, 4], metres to metres, and ``P2`` f64[3, 4], from there to pixels."""
    matrices = read_matrices(file, _SHAPES, ("R0_rect", "Tr_velo_to_cam"))
    to_rect, to_camera = np.eye(4), np.eye(4)
    to_rect[:3, :3], to_camera[:3] = matrices["R0_rect"], matrices["Tr_velo_to_cam"]
    velo_to_rect = to_rect @ to_camera
    tilt_deg = np.degrees(np.arccos(np.clip(-velo_to_rect[1, 2], -1, 1)))  # boxes are upright in both frames
    found, expected = f"y at {tilt_deg:.0f} degrees from down", "x right, y down, z forward in the camera"
    check(bool(tilt_deg <= _MAX_TILT_DEG), f"{file}: Tr_velo_to_cam", found, expected)
    return {"velo_to_rect": velo_to_rect, "P2": matrices["P2"]}


def _read_split(root: Path, split: str, clouds: set[str]) -> tuple[str, ...]:
    check_name(f"{root / 'ImageSets'}: split", split, sorted(_stems(root / "ImageSets", ".txt")))
    file = root / "ImageSets" / f"{split}.txt"
    return distinct_names(((where, " ".join(words)) for where, words in read_lines(file)), clouds, str(file))


def _stems(folder: Path, ending: str) -> set[str]:
    return {file.stem for file in some_files(folder, ending, "at least one")}
