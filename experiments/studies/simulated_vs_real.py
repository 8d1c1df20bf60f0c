"""How near does the simulated world come to real streets?

    python -m experiments.studies.simulated_vs_real --data FOLDER --pictures /tmp/pictures

FOLDER holds ``nuscenes_scene0523/`` (40 keyframes of one street), ``nuscenes_scene0103/`` (two of another),
``nuscenes_scene0061/`` (one of a third) and ``ten_sweep_cloud/`` (one fused cloud). Prints, of simulated and real,
the points that show an object by class and range, what one sweep fills of the range image, what multi-round
projection keeps of ten sweeps, and what ground, rings, intensities and clutter look like, in varied streets
("city": drives and training frames) and in plain ones; draws objects of every class side by side where a folder is
named for them.

The real figures are those of two streets: an object of the first is seen up to forty times. Medians are over the
boxes that hold a point; "visible" counts those alone that are annotated as 80-100 % visible, in the cameras of the
real scene, by the rays of the simulated LiDAR. Cost: two minutes on a CPU core, 550 MB. The result is in
README.md.
"""

import dataclasses
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmarks.latency import fused_cloud
from experiments.benchmarks.mrv_figures import ROUNDS, kept_by_rounds
from experiments.script import Options, real_data, run_script, save
from experiments.sweep_statistics import Figures, sweep_statistics
from fcos_lidar_jax.classes import NUSCENES_CLASSES
from fcos_lidar_jax.config import WHOLE_SWEEP
from fcos_lidar_jax.data.frame import Frame
from fcos_lidar_jax.data.keyframe import read_keyframe
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.projection import close_to_sensor, project_points
from fcos_lidar_jax.sensors import NUSCENES_HDL32E as SENSOR
from fcos_lidar_jax.simulation.frame_set import UNSEEN_SEED, SimulatedFrames, city_frames
from fcos_lidar_jax.simulation.nuscenes_export import write_dataset
from fcos_lidar_jax.simulation.render import DatasetSpec
from fcos_lidar_jax.visualization.figure import new_figure, save_png

RANGES_M = ((0, 10), (10, 20), (20, 30), (30, 50))
EXAMPLES = 3
FEW = 10  # Boxes with a point, below which a median is not compared.


@dataclasses.dataclass(frozen=True)
class Args(Options):
    """What to compare, and where the pictures go."""

    data: Path | None = None  # Folder with the real data; default: the environment's FCOS_LIDAR_REAL_DATA.
    pictures: Path | None = None
    """Folder for pictures, which show real data: not in a repository. None draws none."""
    scenes: int = 24  # Simulated scenes of four keyframes.
    seed: int = 0  # Of the simulated scenes.
    rolling_shutter: bool = True  # Simulate with a rolling shutter.
    frames: int = 40  # Simulated training frames, of varied and of plain streets.


@dataclasses.dataclass(frozen=True)
class Keyframe(Frame):
    """One sweep, close points and no-returns included, with all its boxes."""

    visible: np.ndarray = dataclasses.field(kw_only=True)  # bool[m]: annotated as 80-100 % visible.


def _keyframes(data: NuScenes) -> list[Keyframe]:
    files = (data.tables / f"{name}.json" for name in ("sample_annotation", "visibility"))
    rows, levels = (json.loads(file.read_text(encoding="utf-8")) for file in files)
    full = {row["token"] for row in levels if row["level"] == "v80-100"}
    in_full_view = {row["token"] for row in rows if row["visibility_token"] in full}
    found = []
    for token in data.sample_tokens:
        truth, points = data.boxes(token), data.fuse_sweeps(token, WHOLE_SWEEP)[0]
        visible = np.array([token in in_full_view for token in truth.tokens], bool)
        found.append(Keyframe(points, truth.boxes, truth.labels, truth.num_lidar_pts, visible=visible))
    return found


def points_by_range(frames: list[Keyframe]) -> dict[str, dict[str, dict[str, Any]]]:
    """Class -> range -> boxes, share of them without a point, medians of the others' points."""
    names = ("labels", "boxes", "num_points", "visible")
    labels, boxes, counts, visible = (np.concatenate([getattr(f, name) for f in frames]) for name in names)
    distance = np.hypot(boxes[:, 0], boxes[:, 1])

    def summary(here: np.ndarray) -> dict[str, Any]:
        chosen, shown, clear = counts[here], counts[here & (counts > 0)], counts[here & visible & (counts > 0)]
        return {
            "boxes": len(chosen),
            "empty": round(float((chosen == 0).mean()), 2) if len(chosen) else None,
            "median": float(np.median(shown)) if len(shown) else None,
            "visible": len(clear),
            "visible_median": float(np.median(clear)) if len(clear) else None,
        }

    within = {f"{low}-{high} m": (distance >= low) & (distance < high) for low, high in RANGES_M}
    return {
        name: {span: summary((labels == label) & here) for span, here in within.items()}
        for label, name in enumerate(NUSCENES_CLASSES)
    }


def _sweep_figures(frame: Keyframe) -> Figures:
    close = close_to_sensor(frame.points, SENSOR, 1.0)
    far = frame.points[~close]
    distance = np.hypot(far[:, 0], far[:, 1])
    image = project_points(_padded(far, 40_960), np.arange(40_960) < len(far), SENSOR, num_rounds=1)
    spans = {f"{a}-{b} m": ((distance >= a) & (distance < b)).sum() for a, b in (*RANGES_M, (50, 200))}
    return {
        "share of close points and no-returns": float(close.mean()),
        "points": len(far),
        **{f"points at {span}": number for span, number in spans.items()},
        "cells filled": (np.asarray(image.point_index) >= 0).sum(),
        "intensity, median": np.median(far[:, 3]),
        "intensity, mean": far[:, 3].mean(),
    }


def round_figures(cloud: np.ndarray) -> Figures:
    """What multi-round projection keeps of ten fused sweeps; close points dropped, as are the padding's."""
    found = kept_by_rounds(_padded(cloud, 300_000), SENSOR)
    with_priority, without = found["prioritized"], found["not prioritized"]
    row = {"points": found["in_range"], "cells filled": with_priority["kept"]["1"]}
    row |= {f"% kept by {n} rounds": with_priority["percent"][str(n)] for n in ROUNDS}
    row["cells of the current sweep with priority"] = with_priority["current"]["1"]
    row["cells of the current sweep without priority"] = without["current"]["1"]
    return {name: round(float(value), 1) for name, value in row.items()}


def street_figures(args: Args, real: list[Keyframe], simulated: list[Keyframe]) -> dict[str, Figures]:
    """Mean sweep statistics of real keyframes, simulated drives and simulated training frames."""
    folder = real_data(args.data, "nuscenes_scene0103")
    plain = SimulatedFrames(SENSOR, args.frames, UNSEEN_SEED, num_objects=40, reach_m=45.0, min_points=1)
    city = city_frames(SENSOR, args.frames, UNSEEN_SEED)
    sets: dict[str, Sequence[Frame]] = {
        "scene-0523, even": real[:-1:2],
        "scene-0103": [read_keyframe(folder, SENSOR, i) for i in range(2)],
        "scene-0061": real[-1:],
        "city drives": simulated,
        "city frames": [city.frame(i) for i in range(args.frames)],
        "plain frames": [plain.frame(i) for i in range(args.frames)],
    }
    return {name: _averaged([sweep_statistics(f, SENSOR) for f in frames], 3) for name, frames in sets.items()}


def print_streets(figures: dict[str, Figures]) -> None:
    """One line a figure, one column a set."""
    print(f"\n{'':34}" + "".join(name.rjust(18) for name in figures))
    for name in next(iter(figures.values())):
        print(f"{name:34}" + "".join(f"{row[name]:18.3f}" for row in figures.values()))


def _padded(points: np.ndarray, size: int) -> np.ndarray:
    return np.pad(points, ((0, size - len(points)), (0, 0)))


def _averaged(rows: list[Figures], digits: int) -> Figures:
    return {name: round(float(np.mean([row[name] for row in rows])), digits) for name in rows[0]}


def _print_figures(title: str, simulated: Figures, real: Figures) -> None:
    print(f"\n{title:<44}{'simulated':>12}{'real':>12}{'ratio':>8}")
    for name, value in real.items():
        print(f"{name:<44}{simulated[name]:>12.5g}{value:>12.5g}{simulated[name] / value:>8.2f}")


def print_objects(simulated: dict[str, Any], real: dict[str, Any]) -> None:
    """Points an object by class and range; ratios where both have enough boxes."""
    title = "points an object, simulated | real"
    print(f"\n{title:<36}{'boxes':>12}{'empty':>14}{'median':>16}{'ratio':>7}{'visible: median':>18}{'ratio':>7}")
    for name, ranges in real.items():
        for span, there in ranges.items():
            here, line = simulated[name][span], f"{name:<22}{span:<12}"
            for key, width in (("boxes", 14), ("empty", 14), ("median", 16), ("visible_median", 18)):
                line += f"{_text(here[key])} | {_text(there[key])}".rjust(width)
                if "median" in key:
                    line += f"{_text(compared(here, there, key)):>7}"
            print(line)


def _text(value: float | None) -> str:
    """Three digits or more, a dash for nothing."""
    return "-" if value is None else str(round(value, 2) if value < 10 else round(value))


def compared(here: dict[str, Any], there: dict[str, Any], key: str) -> float | None:
    """Ratio of the medians; None where either side has too few boxes with a point."""
    for row in (here, there):
        number = row["visible"] if key == "visible_median" else row["boxes"] * (1 - (row["empty"] or 0))
        if number < FEW:
            return None
    return here[key] / there[key]


def best_examples(frames: list[Keyframe], label: int) -> list[tuple[Keyframe, int]]:
    """The objects of a class with most points, of different sizes, so not one object again and again."""
    objects = [(frame, int(i)) for frame in frames for i in np.flatnonzero(frame.labels == label)]
    chosen: list[tuple[Keyframe, int]] = []
    for frame, i in sorted(objects, key=lambda item: -item[0].num_points[item[1]]):
        if all(np.abs(frame.boxes[i, 3:6] - f.boxes[j, 3:6]).max() > 0.02 for f, j in chosen):
            chosen.append((frame, i))
    return chosen[:EXAMPLES]


def alike(frames: list[Keyframe], label: int, example: tuple[Keyframe, int]) -> tuple[Keyframe, int]:
    """The object of a class most like another in distance and number of points."""

    def features(frame: Keyframe, i: int) -> np.ndarray:
        return np.log([np.hypot(*frame.boxes[i, :2]), frame.num_points[i]])

    shown = [(frame, (frame.labels == label) & (frame.num_points > 0)) for frame in frames]
    objects = [(frame, int(i)) for frame, here in shown for i in np.flatnonzero(here)]
    return min(objects, key=lambda item: np.abs(features(*item) - features(*example)) @ [2, 1])


def draw_objects(simulated: list[Keyframe], real: list[Keyframe], label: int, path: Path) -> None:
    """Side and top views of objects of one class, real ones on the left."""
    examples = best_examples(real, label)
    figure = new_figure(16, 3.2 * len(examples))
    axes = figure.subplots(len(examples), 4, squeeze=False)
    pairs = (("real", examples), ("simulated", [alike(simulated, label, example) for example in examples]))
    for column, (source, objects) in enumerate(pairs):
        for row, (frame, i) in enumerate(objects):
            x, y, z, l, w, h, yaw = (float(v) for v in frame.boxes[i, :7])
            c, s = np.cos(yaw), np.sin(yaw)
            d = frame.points[:, :3] - (x, y, z)
            near = np.linalg.norm(d, axis=1) < np.hypot(l, w) / 2 + 0.7
            along, across, up = (c * d[:, 0] + s * d[:, 1])[near], (c * d[:, 1] - s * d[:, 0])[near], d[near, 2]
            for k, (other, size) in enumerate(((up, h), (across, w))):
                ax = axes[row, 2 * column + k]
                ax.scatter(along, other, s=4, c=frame.points[near, 3], vmin=0, vmax=80, cmap="viridis")
                ax.plot(np.array([-1, 1, 1, -1, -1]) * l / 2, np.array([-1, -1, 1, 1, -1]) * size / 2, "r", lw=0.7)
                ax.set_aspect("equal")
                ax.set_title(f"{source}, {frame.num_points[i]} points, {np.hypot(x, y):.0f} m", fontsize=8)
    figure.suptitle(f"{NUSCENES_CLASSES[label]}: side and top")
    save_png(figure, path, dpi=80)


def main(args: Args) -> None:
    """Simulate, compare, print."""
    street, other = (real_data(args.data, f"nuscenes_scene{number}") for number in ("0523", "0061"))
    real, single = _keyframes(NuScenes(street, "v1.0-scene0523")), read_keyframe(other, SENSOR)
    real.append(Keyframe(**vars(single), visible=np.zeros(len(single.labels), bool)))
    with tempfile.TemporaryDirectory() as work:
        spec = DatasetSpec(args.scenes, args.seed, 4, SENSOR, args.rolling_shutter, "v1.0-simulated")
        write_dataset(spec, Path(work), workers=1, report=lambda done: None)
        data = NuScenes(work, spec.version)
        simulated = _keyframes(data)
        each = [round_figures(data.sweeps(token)) for token in data.sample_tokens[3 :: spec.keyframes]]
    ten_sweeps = _averaged(each, 1), round_figures(fused_cloud(args.data, SENSOR)[0])
    one_sweep = (_averaged([_sweep_figures(frame) for frame in frames], 3) for frames in (simulated, real))
    objects = points_by_range(simulated), points_by_range(real)
    record: dict[str, Any] = {"scenes": args.scenes, "rolling_shutter": args.rolling_shutter}
    for title, figures in (("ten sweeps", ten_sweeps), ("one sweep", one_sweep)):
        record[title] = dict(zip(("simulated", "real"), figures, strict=True))
        _print_figures(title, **record[title])
    print_objects(*objects)
    record["streets"] = street_figures(args, real, simulated)
    print_streets(record["streets"])
    spread = {name: [min(row[name] for row in each), max(row[name] for row in each)] for name in each[0]}
    least_and_most = {"ten sweeps, least and most of simulated scenes": spread}
    record |= least_and_most | {"objects": dict(zip(("simulated", "real"), objects, strict=True))}
    if args.pictures is not None:
        for label, name in enumerate(NUSCENES_CLASSES):
            draw_objects(simulated, real, label, args.pictures / f"{name}.png")
    save(record, args.out, json.dumps(least_and_most))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
