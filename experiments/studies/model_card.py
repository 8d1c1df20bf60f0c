"""Model card of shipped weights, generated from measured figures.

    python -m experiments.studies.model_card --name hdl32e

Writes ``fcos_lidar_jax/weights/NAME/README.md`` from ``NAME.json``, written by ``shipped_weights --export``, and
``transfer.json`` of the same folder. Figures of weights other than those in the package are left out.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import fcos_lidar_jax
from experiments.script import markdown_table, run_script
from fcos_lidar_jax.checkpoints.storage import read_description
from fcos_lidar_jax.files import atomic_write, read_json
from fcos_lidar_jax.inference import load_trained
from fcos_lidar_jax.models.detector import count_parameters

RESULTS = Path("experiments/results")
SHIPPED = Path(fcos_lidar_jax.__file__).parent / "weights"
_BANDS = ("all", "0-20 m", "20-40 m")
_UNSEEN = "with class frequencies of cities and half as many objects as in training"
_AXES = "x right, y forward, z up from the sensor, in metres"
_WEAK_AP, _WEAK_BOXES = 0.05, 10
"""Classes with less AP are listed as hardly detected, if they have at least this many boxes."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of the model card."""

    name: Literal["quickstart", "hdl32e", "hdl64e"]  # Name of the weights.


def write_card(name: str, results: Path, training: Mapping[str, Any] | None = None) -> Path:
    """Write the model card of shipped weights beside them; returns the file.

    Args:
        name: name of the weights.
        results: folder of ``NAME.json`` and, if measured, ``transfer.json``.
        training: content of ``NAME.json``; default: read from the file.
    """
    folder = SHIPPED / name
    file, weights = results / f"{name}.json", read_description(folder)["hash"]
    record = training or read_json(file, dict[str, Any])
    if "training" not in record:
        raise ValueError(f"{file}: training: missing, expected the training that shipped_weights --export records")
    if record.get("hash", weights) != weights:
        raise ValueError(f"{file}: hash: got {record['hash']}, expected the hash of the weights: {weights}")
    figures = _figures(record, results / "transfer.json", weights)
    lines = [*_about(name, record), *figures, *_training(name, record)]
    path = folder / "README.md"
    atomic_write(path, "\n".join(lines) + "\n")
    return path


def _about(name: str, record: Mapping[str, Any]) -> Iterator[str]:
    detector, trained = load_trained(SHIPPED / name), record["training"]
    parameters = count_parameters(detector.variables["params"])["total"]
    yield f"# {name}\n"
    yield f"Preset `{trained['preset']}` for the sensor `{detector.sensor.name}`: {parameters:,} parameters,"
    yield f"{record['bytes'] / 2**20:.1f} MiB as float16, under the licence of the package.\n"
    yield "## What it is for\n"
    yield f"The input is one sweep of this sensor, in one projection round: {_AXES}, and intensities from 0"
    yield "to 255. The classes are"
    yield f"{', '.join(label.replace('_', ' ') for label in detector.classes)}.\n"
    yield "The weights are a starting point for fine-tuning and for first trials, not a usable detector. They were"
    yield "trained only on simulated streets. As the tables show, they miss objects and report objects that do not"
    yield "exist. Other sensors need other weights.\n"
    yield "## Scores\n"
    low, high = record["interval"]["low"], record["interval"]["high"]
    scored = f"mAP {record['mAP']:.3f} ({low:.3f} to {high:.3f})"
    streets = "of the same kind of streets" if name == "quickstart" else _UNSEEN
    yield f"On {record['unseen_frames']} unseen simulated single frames, {streets}: {scored}.\n"


def _training(name: str, record: Mapping[str, Any]) -> Iterator[str]:
    legs = [*record["earlier"], record["training"]]
    frames = sum(leg["frames_seen"] for leg in legs)
    chain = f"{len(legs)} trainings, each from the weights of the one before" if len(legs) > 1 else "one training"
    last = legs[-1]
    only = ""
    if "trained" in last:
        numbers = f"{last['num_boxes']} boxes of at most {last['num_points']} points per frame"
        only = f"\nThe last training changed only the second look ({numbers})."
    yield "\n## Training data\n"
    yield f"Only simulated streets: {frames:,} frames in {chain}.{only}"
    yield f"`experiments/results/{name}.json` has the seeds, steps, scores and machines, and the weights that were"
    yield "averaged. If the preset had become larger, they were enlarged first."
    if share := next((leg["logit_adjustment"] for leg in reversed(legs) if "logit_adjustment" in leg), None):
        yield "\nnuScenes and the training streets have different class frequencies. So the export added"
        yield f"{share} log(frequency in nuScenes / frequency in training) to each class logit (logit adjustment)."
    yield f"\nTrained and exported by `python -m experiments.studies.shipped_weights --name {name} --work FOLDER`."


def _figures(record: Mapping[str, Any], file: Path, weights: str) -> Iterator[str]:
    if record["name"] == "hdl64e":
        yield f"Average precision: {', '.join(f'{name} {ap:.3f}' for name, ap in record['AP'].items())}."
        yield "These weights have not been scored on KITTI's data, nor on any other real sweep."
        return
    measured = read_json(file, dict[str, Any]) if file.exists() else {}
    command = "`python -m experiments.studies.transfer --data FOLDER`"
    if measured.get("checkpoint", {}).get("hash") != weights:
        yield f"Not measured yet with these weights: run {command}."
        return
    yield f"Average precision by centre distance, mean over 0.5, 1, 2 and 4 m, measured by {command}."
    yield "Numbers of boxes are in brackets. Bootstrap intervals resample simulated drives or real keyframes."
    yield "Intervals over keyframes are too narrow, because keyframes of a scene are similar."
    yield "mAP is the mean over the classes that occur: do not compare it between scenes with other classes."
    yield "*Official* scores are the nuScenes benchmark's own."
    for place, part in measured.items():
        if isinstance(part, dict) and "all" in part:
            yield from _part(place, part)
    if found := measured.get("fine_tuning"):
        starts = {"from the checkpoint": "from these weights", "from scratch": "from random ones"}
        scores = [f"{found[start]['all']['mAP']:.3f} {text}" for start, text in starts.items() if start in found]
        yield f"\n### Fine-tuned on {found['keyframes']} real keyframes, {found['steps']} steps\n"
        yield f"mAP on other keyframes of the scene: {', '.join(scores)}."


def _part(name: str, part: Mapping[str, Any]) -> Iterator[str]:
    interval = part["all"].get("interval")
    scores = [f"mAP {part['all']['mAP']:.3f}" + (f" ({_text(interval)})" if interval else "")]
    for key in ("official mAP", "official NDS"):
        if found := part.get(key):
            scores.append(f"{key} {found['score']:.3f} ({_text(found['interval'])})")
    source = "simulated drives" if name == "simulated" else f"real, {name}"
    number = f"{part['keyframes']} keyframe{'s' if part['keyframes'] > 1 else ''}"
    yield f"\n### {source[0].upper()}{source[1:]}: {number}\n"
    yield f"{', '.join(scores)}.\n"
    aps, truths, rows = part["all"]["AP"], part["all"]["truths"], []
    for label in aps:
        bands = [part[band] for band in _BANDS]
        shown = [f"{b['AP'][label]:.3f} ({b['truths'][label]})" if label in b["AP"] else "-" for b in bands]
        rows.append([label.replace("_", " "), *shown])
    yield from markdown_table(["class", *_BANDS], rows)
    often = [label for label, boxes in truths.items() if boxes >= _WEAK_BOXES]
    if weak := [label.replace("_", " ") for label in often if aps[label] < _WEAK_AP]:
        yield f"\nHardly detected (AP below {_WEAK_AP:g} with at least {_WEAK_BOXES} boxes): {', '.join(weak)}."


def _text(interval: Any) -> str:
    return " to ".join(f"{value:.3f}" for value in interval)


def main(args: Args) -> None:
    """Write the card and print its path."""
    print(write_card(args.name, RESULTS))


if __name__ == "__main__":
    run_script(main, Args, __doc__)
