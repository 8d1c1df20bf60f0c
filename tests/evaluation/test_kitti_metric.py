"""KITTI's metric: plain loops with Shapely as oracle, also for what is ignored, and cases by hand."""

import numpy as np
import pytest
from kitti_oracle import overlap, score
from refusal import refused

from fcos_lidar_jax.evaluation.kitti import KINDS, MIN_OVERLAP, describe_kitti, evaluate_kitti, overlaps

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
SIZES = {"Pedestrian": (1.7, 0.6, 0.8), "Person_sitting": (1.3, 0.6, 0.8), "Cyclist": (1.7, 0.6, 1.8)}
NUMBER = 50
"""Objects in the cases by hand: more than the 41 positions."""


def line(
    kind="Car", x=0.0, *, score=None, high=50.0, occlusion=0, truncation=0.0, alpha=0.0, wide=50.0, **at
) -> str:
    """A line of a file; the box in the image moves by 100 pixels per metre."""
    h, w, l = SIZES.get(kind, (1.5, 1.6, 4.0))
    y, z, ry = ({"y": 1.7, "z": 20.0, "ry": 0.0} | at).values()
    ending, left = "" if score is None else f" {score!r}", 600 + 100 * x
    pixels = f"{left!r} 100 {left + wide!r} {100 + high!r}"
    return f"{kind} {truncation} {occlusion} {alpha!r} {pixels} {h} {w} {l} {x!r} {y!r} {z!r} {ry!r}{ending}\n"


def region(left=0.0, right=2000.0, top=0.0, bottom=2000.0) -> str:
    """A line of a DontCare region."""
    return f"DontCare -1 -1 -10 {left!r} {top!r} {right!r} {bottom!r} -1 -1 -1 -1000 -1000 -1000 -10\n"


def evaluate_texts(tmp_path, texts, **options):
    folders = tmp_path / "results", tmp_path / "labels"
    for folder in folders:
        folder.mkdir(exist_ok=True)
        for file in folder.iterdir():
            file.unlink()
    for i, (label, result) in enumerate(texts):
        (folders[0] / f"{i:06d}.txt").write_text(result)
        (folders[1] / f"{i:06d}.txt").write_text(label)
    return evaluate_kitti(*folders, **options)


def random_frame(rng, *, plain=False):
    """Objects in clumps, and detections near them: equal ones, equal scores, other classes, limits met exactly;
    and regions.

    In plain frames most are cars that count, so that there are more objects than positions.
    """
    truths, found = [], []
    for _ in range(rng.integers(0, 9)):
        kind, place = str(rng.choice(TYPES, p=(0.3, 0.1, 0.05, 0.2, 0.1, 0.15, 0.05, 0.05))), {}
        for name, low, high in (("x", -20, 20), ("z", 5, 40), ("y", 1, 2), ("ry", -np.pi, np.pi)):
            place[name] = float(rng.uniform(low, high))
        limits = {"high": float(rng.choice([20, 25, 25.01, 30, 40, 40.01, 60])), "occlusion": rng.integers(0, 4)}
        limits["truncation"] = rng.choice([0, 0, 0.15, 0.16, 0.3, 0.5, 0.51])
        if plain and rng.random() < 0.8:
            kind, limits = "Car", {}
        for _ in range(rng.choice([1, 1, 2])):
            truths.append(line(kind, **place, **limits, alpha=float(rng.uniform(-4, 4))))
            place["x"] += 0.15
        for _ in range(rng.integers(0, 5)):
            guess = kind if rng.random() < 0.8 else str(rng.choice(TYPES))
            near = {name: float(v + rng.normal(0, 0.08)) for name, v in place.items()}
            high = float(rng.choice([20, 24.99, 25, 39.99, 40, 60]))
            score = float(rng.random().__round__(rng.choice([1, 6])))
            text = line(guess, **near, score=score, high=high, alpha=float(rng.uniform(-4, 4)))
            found += [text] * rng.choice([1, 1, 2])
    for left, wide, top, bottom in rng.uniform(
        (-1500, 0, 90, 120), (2500, 1000, 115, 170), (rng.integers(0, 4), 4)
    ).tolist():
        truths.append(region(left, left + wide, top, bottom))
    rng.shuffle(truths)
    rng.shuffle(found)
    return "".join(truths), "".join(found)


@pytest.mark.parametrize("seed", range(6))
def test_equals_the_plain_loops(tmp_path, seed):
    rng, plain = np.random.default_rng(seed), bool(seed % 2)
    texts = [random_frame(rng, plain=plain) for _ in range(rng.integers(20, 50) if plain else rng.integers(1, 20))]
    summary = evaluate_texts(tmp_path, texts)
    assert summary["num_frames"] == len(texts)
    expected = score(texts)
    assert {metric for _, metric, _ in expected} == {*KINDS}
    for (name, metric, difficulty), (number, percent) in expected.items():
        ours = summary["classes"][name.capitalize()]
        assert ours["num_truth"][difficulty] == number
        assert ours[metric][difficulty] == (pytest.approx(percent, abs=1e-6) if number else None)


def test_overlaps_equal_shapelys():
    """Of boxes that lie anyhow, and of equal ones."""
    rng = np.random.default_rng(0)
    a = np.concatenate(
        [rng.uniform(0.5, 4, (300, 3)), rng.uniform(-1, 1, (300, 3)), rng.uniform(-4, 4, (300, 1))], 1
    )
    b = np.where(np.arange(300)[:, None] < 20, a, a[rng.permutation(300)])
    rows = [
        [dict(zip(("h", "w", "l", "x", "y", "z", "ry"), row, strict=True)) for row in m.tolist()] for m in (a, b)
    ]
    for values, metric in zip(overlaps(a, b), ("bev", "3d"), strict=True):
        np.testing.assert_allclose(values, [overlap(p, q, metric) for p, q in zip(*rows, strict=True)], atol=1e-9)


def street(kind="Car", number=NUMBER, **options):
    """Objects side by side, all of which count."""
    return [line(kind, 6.0 * i, **options) for i in range(number)]


def ap(tmp_path, truths, found, name="Car", metrics=("3d",)):
    """Average precisions by difficulty, which must be the same for all ``metrics``."""
    scores = evaluate_texts(tmp_path, [("".join(truths), "".join(found))])["classes"][name]
    assert all(scores[metric] == scores[metrics[0]] for metric in metrics)
    return scores[metrics[0]]


def all_of(value):
    return pytest.approx(dict.fromkeys(("easy", "moderate", "hard"), value))


@pytest.mark.parametrize("name", MIN_OVERLAP)
def test_perfect_one_missing_and_one_too_many(tmp_path, name):
    truths, found, where = street(name), street(name, score=0.8), (name, KINDS)
    assert ap(tmp_path, truths, found, *where) == all_of(100)
    # Recall 49 / 50 reaches the positions up to 39 / 40, the first of which is not averaged.
    assert ap(tmp_path, truths, found[1:], *where) == all_of(97.5)
    assert ap(tmp_path, truths, [*found, line(name, -9.0, score=0.9)], *where) == all_of(100 * 50 / 51)
    assert ap(tmp_path, truths, [*found, line(name, -9.0, score=0.1)], *where) == all_of(100)
    assert ap(tmp_path, truths, [], *where) == all_of(0)
    assert ap(tmp_path, [], found, *where) == dict.fromkeys(("easy", "moderate", "hard"))


def test_the_table_counts_the_objects_of_each_difficulty(tmp_path):
    cars = [line("Car", 0.0), *(line("Car", 6.0 * i, high=30) for i in range(1, 4)), line("Van", 30.0)]
    summary = evaluate_texts(tmp_path, [("".join(cars), "")], classes=["Car", "Cyclist"])
    head, bev, *_, cyclist, few = describe_kitti(summary).splitlines()
    assert few.startswith("few objects of Car: ")
    assert head.endswith("     hard objects: easy / moderate / hard")
    assert " ".join(bev.split()) == "Car 0.7 bev 0.00 0.00 0.00 1 / 4 / 4"
    assert " ".join(cyclist.split()) == "Cyclist 0.5 aos - - - 0 / 0 / 0"
    assert len(head) == len(bev) == len(cyclist)
    unseen = evaluate_texts(tmp_path, [(line(high=0), line(score=0.5))])  # labels without boxes in the image
    assert "no object is evaluated: the difficulty needs labels with boxes in the" in describe_kitti(unseen)


def test_an_overlap_must_exceed_the_least_and_space_counts_the_height(tmp_path):
    """A pedestrian shifted by a third of its extent overlaps by exactly a half."""

    def people(x=0.0, y=1.7, **options):
        rows = [line("Pedestrian", 6.0 * i + x, y=y, **options) for i in range(NUMBER)]
        return [row.replace("1.7 0.6 0.8", "1.5 0.5 1.5") for row in rows]

    truths, above = people(), ("Pedestrian", ["bev"])
    for shift, bev in ((0.5, 0), (0.499, 100)):
        assert ap(tmp_path, truths, people(shift, score=0.8), *above) == all_of(bev)
    for lift, space in ((0.499, 100), (0.501, 0)):
        assert ap(tmp_path, truths, people(y=1.7 - lift, score=0.8), "Pedestrian") == all_of(space)


PEDESTRIANS = street("Pedestrian", score=0.8)
FALSE = line("Pedestrian", 3.0, score=0.9)  # its left side is 900
IMAGE = {  # detections of fifty pedestrians, another line of the labels -> percent of image boxes and orientations
    "half of the box": (street("Pedestrian", score=0.8, wide=25.0), "", 0, 0),
    "more than half": (street("Pedestrian", score=0.8, wide=25.1), "", 100, 100),
    "half in a region": ([*PEDESTRIANS, FALSE], region(right=925.0), 100 * 50 / 51, 100 * 50 / 51),
    "more than half in a region": ([*PEDESTRIANS, FALSE], region(right=925.1), 100, 100),
    "no angle": ([*PEDESTRIANS, FALSE.replace("0.0 0 0.0", "0.0 0 -10")], "", 100 * 50 / 51, None),
    "no image boxes": ([PEDESTRIANS[0].replace("600.0 100 650.0 150.0", "-1 -1 -1 -1")], "", None, None),
}


@pytest.mark.parametrize("case", IMAGE)
def test_image_boxes_and_orientation(tmp_path, case):
    found, more, *percents = IMAGE[case]
    texts = [("".join([*street("Pedestrian"), more]), "".join(found))]
    scores = evaluate_texts(tmp_path, texts)["classes"]["Pedestrian"]
    assert [*map(scores.get, ("image", "aos"))] == [None if each is None else all_of(each) for each in percents]
    if len(found) > NUMBER:  # regions excuse in the image only
        assert scores["bev"] == scores["3d"] == all_of(100 * 50 / 51)


FLAT = "Car -1 -1 -10 100 100 150 150 -1 -1 -1 -1000 -1000 -1000 -10 0.9\n"
"""A detection in the image only."""

ODD_RESULTS = {  # what changes in fifty perfect detections: the moderate AP of cars, and what is told
    "case": (lambda rows: [row.replace("Car", "cAR") for row in rows], 100.0, ""),
    "unknown types": (
        lambda rows: [*rows, line("Person", -9.0, score=0.9), *[line("Bicycle", 1.0, score=0.9)] * 2],
        *(100.0, "skipped, none of KITTI's types: 2 Bicycle, 1 Person"),
    ),
    "a low unknown type": (  # taken by an object, as any low detection
        lambda rows: [line("Person", score=0.9, high=20.0), *rows],
        *(97.5, "skipped, none of KITTI's types: 1 Person"),
    ),
    "image only": (
        lambda rows: [*rows, FLAT],
        100 * 50 / 51,
        "without a box in 3D, and therefore false in bev and 3d: 1 ",
    ),
    "image only, of no type": (
        lambda rows: [*rows, FLAT.replace("Car", "Bicycle"), FLAT.replace("Car", "DontCare")],
        *(100.0, "skipped, none of KITTI's types: 1 Bicycle"),
    ),
}


@pytest.mark.parametrize("case", ODD_RESULTS)
def test_results_are_read_as_by_the_development_kit(tmp_path, case):
    """From the folder data, beside which the development kit writes other text files."""
    change, percent, told = ODD_RESULTS[case]
    label, result = "".join(street()), "".join(change(street(score=0.8)))
    files = {"labels/000000": label, "results/data/000000": result, "results/stats_car_detection": "0 0"}
    for name, text in files.items():
        (file := tmp_path / f"{name}.txt").parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    summary = evaluate_kitti(tmp_path / "results", tmp_path / "labels")
    assert summary["classes"]["Car"]["3d"]["moderate"] == pytest.approx(percent)
    lines = [text for text in describe_kitti(summary).splitlines()[1:] if not text.startswith((*MIN_OVERLAP,))]
    assert [text.startswith(told) for text in lines] == [True] * bool(told)


def test_boxes_in_the_image_only_and_in_3d_only_have_their_own_rows(tmp_path):
    truth = street()
    columns = [row.split() for row in street(score=0.8)]
    flat = "".join(" ".join([*c[:8], *["-1"] * 3, *["-1000"] * 3, "-10", c[15]]) + "\n" for c in columns)
    summary = evaluate_texts(tmp_path, [("".join(truth), flat)])
    assert summary["classes"]["Car"]["image"]["moderate"] == pytest.approx(100.0)
    assert summary["classes"]["Car"].keys().isdisjoint(("bev", "3d"))
    deep = "".join(" ".join([*c[:3], "-10", *["-1"] * 4, *c[8:]]) + "\n" for c in columns)
    summary = evaluate_texts(tmp_path, [("".join(truth), deep)])
    assert "image" not in summary["classes"]["Car"]
    assert summary["classes"]["Car"]["3d"]["moderate"] == 0  # as in the development kit
    told = "lower than 25 pixels in the image, and therefore ignored: 50 detections"
    assert told in describe_kitti(summary)


def test_bad_results_get_one_line(tmp_path):
    labels = tmp_path / "labels"
    with refused(f"{tmp_path / 'none'}: no .txt file in it, expected one for every frame"):
        evaluate_kitti(tmp_path / "none", labels)
    with refused("000000.txt: line 2: got 15 values, expected 16, the score last"):
        evaluate_texts(tmp_path, [(line(), line(score=0.5) + line())])
    (labels / "000000.txt").unlink()
    (tmp_path / "results" / "000000.txt").write_text(line(score=0.5))
    with refused(f"{labels / '000000.txt'}: no such file, expected text"):
        evaluate_kitti(tmp_path / "results", labels)
