"""Do hostile clouds get through the projection and the detector without harm?

    python -m experiments.studies.adversarial_clouds

Random and adversarial clouds: one point many times, ties, points on beams, on cell edges and on the limits of the
sensor, denormal, huge and non-finite values, negative zeros, single values spoilt, and rows of any mixture of
these. Expected: image and boxes finite, every row in the image once at most and with its own values, counts that
agree, scores in [0, 1], the same bits twice. Twenty minutes on a core.
"""

import dataclasses
import time
from collections.abc import Callable

import jax
import numpy as np

from experiments.script import Options, run_script, save
from fcos_lidar_jax.data.cloud_policy import make_cloud
from fcos_lidar_jax.inference import TrainedDetector, load_trained
from fcos_lidar_jax.projection import project_points
from fcos_lidar_jax.sensors import ARGOVERSE2, TINY, Sensor
from fcos_lidar_jax.types import RangeImage

POINTS = 256  # rows of a cloud of the projection, all compiled once
SENSORS = (TINY, dataclasses.replace(ARGOVERSE2, num_columns=64))
ROUNDS = 3
_FINFO = np.finfo(np.float32)
_MAGNITUDES = (
    0.0,
    1e-45,
    _FINFO.tiny,
    _FINFO.eps,
    1.0,
    59.999,
    60.0,
    65_535.0,
    65_536.0,
    2.0**24,
    2.0**31,
    2.0**63,
)
EXTREME = np.array(
    [np.nan, *(s * m for m in (*_MAGNITUDES, 1e30, _FINFO.max, np.inf) for s in (1, -1))], np.float32
)


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """How many."""

    projected: int = 100_000  # Clouds through the projection.
    detected: int = 10_000  # Clouds through the detector.
    seed: int = 0  # Another seed gives other clouds.


def make_points(rng: np.random.Generator, sensor: Sensor, number: int) -> np.ndarray:
    """f32[number, c]: a cloud of one kind, or rows of several."""
    kinds = [rng.choice(np.array(KINDS, object))(rng, sensor, number) for _ in range(rng.integers(1, 4))]
    chosen = rng.integers(0, len(kinds), number)
    points = np.stack(kinds)[chosen, np.arange(number)].astype(np.float32)
    if rng.random() < 0.3:  # single values
        hit = rng.random(points.shape) < rng.choice([0.01, 0.2, 1.0])
        points[hit] = rng.choice(EXTREME, hit.sum())
    return points


def _anywhere(rng: np.random.Generator, sensor: Sensor, number: int) -> np.ndarray:
    scale = rng.choice([1e-3, 1.0, sensor.limit_xy_m, 1e3])
    return _columns(rng, sensor, rng.normal(0, 1, (number, 3)) * [scale, scale, min(scale, 3)])


def _on_a_beam(rng: np.random.Generator, sensor: Sensor, number: int) -> np.ndarray:
    """Directions at the centre or on the edge of cells, rarely within the last bit of them."""
    edges = np.concatenate([sensor.inclinations_rad, sensor.row_edges_rad])
    inclination = rng.choice(edges, number)
    azimuth = np.pi - rng.integers(0, 2 * sensor.num_columns + 1, number) * np.pi / sensor.num_columns
    range_m = rng.choice([1e-6, 0.5, 5.0, sensor.limit_xy_m, 2 * sensor.limit_xy_m], number)
    flat = np.cos(inclination) * range_m
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(inclination) * range_m], axis=1)
    xyz = xyz.astype(np.float32)
    return _columns(rng, sensor, _beside(rng, xyz) + sensor.origin_m)


def _on_the_limits(rng: np.random.Generator, sensor: Sensor, number: int) -> np.ndarray:
    xy = rng.choice([-1, -0.5, 0, 0.1, 1], (number, 2)) * sensor.limit_xy_m
    xyz = np.column_stack([xy, rng.choice([*sensor.limit_z_m, 0.0, -1.7], number)]).astype(np.float32)
    return _columns(rng, sensor, _beside(rng, xyz))


def _beside(rng: np.random.Generator, xyz: np.ndarray) -> np.ndarray:
    """The values, or the float32 next to them."""
    towards = np.float32(rng.choice([-np.inf, 0.0, np.inf]))
    return xyz if rng.random() < 0.3 else np.nextafter(xyz, towards)


def _one_point(rng: np.random.Generator, sensor: Sensor, number: int) -> np.ndarray:
    return np.repeat(_anywhere(rng, sensor, 1), number, axis=0)


def _extreme(rng: np.random.Generator, sensor: Sensor, number: int) -> np.ndarray:
    return rng.choice(EXTREME, (number, sensor.point_columns))


def _columns(rng: np.random.Generator, sensor: Sensor, xyz: np.ndarray) -> np.ndarray:
    """Coordinates with intensities, lags of sweeps and laser numbers."""
    number = len(xyz)
    more = [rng.choice([0.0, 1, 255, 70_000], number), rng.choice([0.0, 0.05, 0.45, 100], number)]
    if sensor.row_source == "laser":
        more.append(rng.integers(-1, sensor.num_rows + 1, number))
    return np.column_stack([xyz, *more])


KINDS: list[Callable[[np.random.Generator, Sensor, int], np.ndarray]] = [
    *(_anywhere, _on_a_beam, _on_the_limits, _one_point, _extreme)
]


def check_image(image: RangeImage, points: np.ndarray, valid: np.ndarray, sensor: Sensor) -> None:
    """Raise ValueError where an image is not one of the cloud."""
    index, features = image.point_index, image.features
    filled = index >= 0
    used = index[filled]
    if not np.isfinite(features).all() or features[np.broadcast_to(~filled[:, :, None], features.shape)].any():
        raise ValueError("features: got numbers that are not finite or in empty cells, expected neither")
    if len(np.unique(used)) != len(used) or not valid[used].all() or not np.isfinite(points[used]).all():
        raise ValueError("point_index: got rows twice or rows that do not count, expected neither")
    if not (filled[..., :-1] >= filled[..., 1:]).all():
        raise ValueError("point_index: got a round filled after an empty one, expected none")
    if not 0 <= image.num_dropped <= valid.sum() - len(used):
        raise ValueError(f"num_dropped: got {image.num_dropped} of {valid.sum()} rows, {len(used)} in the image")
    if not np.array_equal(features.transpose(0, 1, 3, 2)[filled][:, [0, 1, 2, 6, 8]], points[used, :5]):
        raise ValueError("features: got other values than those of the points")


def project_clouds(number: int, seed: int) -> dict[str, int]:
    """Project, check and project again; counts of what happened."""
    counts = {"clouds": 0, "points": 0, "in_image": 0, "dropped": 0}
    for i in range(number):
        rng, sensor = np.random.default_rng([seed, i]), SENSORS[i % len(SENSORS)]
        points = make_points(rng, sensor, POINTS)
        valid = rng.random(POINTS) < rng.choice([0.0, 0.5, 1.0], p=[0.05, 0.35, 0.6])
        images = [
            jax.device_get(project_points(points, valid, sensor, num_rounds=ROUNDS, prioritize_current=i % 3 > 0))
            for _ in range(2)
        ]
        try:
            check_image(images[0], points, valid, sensor)
        except ValueError as error:
            raise ValueError(f"cloud {i} of seed {seed}: {error}") from None
        if not _same(*images):
            raise ValueError(f"cloud {i} of seed {seed}: got another image the second time")
        counts["clouds"] += 1
        counts["points"] += int(valid.sum())
        counts["in_image"] += int((images[0].point_index >= 0).sum())
        counts["dropped"] += int(images[0].num_dropped)
    return counts


def detect_clouds(detector: TrainedDetector, number: int, seed: int) -> dict[str, int]:
    """Detect, check and detect again; counts of what happened."""
    counts = {"clouds": 0, "points": 0, "removed": 0, "boxes": 0}
    for i in range(number):
        rng = np.random.default_rng([seed, i, 1])
        points = make_points(rng, detector.sensor, int(rng.choice([1, 7, 500, 3000, 6000])))
        cloud = make_cloud(points, detector.config, sensor=detector.sensor)
        found, again = detector.detect(cloud), detector.detect(cloud)
        where = f"cloud {i} of seed {seed}"
        numbers = np.concatenate([found.boxes.ravel(), found.scores])
        if not np.isfinite(numbers).all() or not ((found.scores >= 0) & (found.scores <= 1)).all():
            raise ValueError(
                f"{where}: got boxes or scores that are none, expected finite ones and scores of 0 to 1"
            )
        if not (found.boxes[found.valid][:, 3:6] > 0).all() or (found.labels >= len(detector.classes)).any():
            raise ValueError(f"{where}: got sizes or labels that are none")
        if not _same(found, again):
            raise ValueError(f"{where}: got other boxes the second time")
        counts["clouds"] += 1
        counts["points"] += cloud.num_points
        counts["removed"] += cloud.num_removed
        counts["boxes"] += int(found.valid.sum())
    return counts


def _same(a: object, b: object) -> bool:
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in leaves)


def main(args: Args) -> None:
    """Project, detect, write."""
    began = time.monotonic()
    projected = project_clouds(args.projected, args.seed)
    print(f"projected in {time.monotonic() - began:.0f} s: {projected}", flush=True)
    began = time.monotonic()
    detected = detect_clouds(load_trained("quickstart"), args.detected, args.seed)
    text = f"detected in {time.monotonic() - began:.0f} s: {detected}"
    save({"seed": args.seed, "projected": projected, "detected": detected}, args.out, text)


if __name__ == "__main__":
    run_script(main, Args, __doc__)
