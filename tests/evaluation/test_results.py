"""Check that results files survive a round trip, and that errors name sample, box and field in one line."""

import json
import re

import numpy as np
import pytest
from made_evaluation import random_boxes
from scipy.spatial.transform import Rotation

from fcos_lidar_jax.evaluation.results import USE_FLAGS, attribute_of, read_results, result_entries, write_results
from fcos_lidar_jax.evaluation.resume_log import ResumeLog
from fcos_lidar_jax.evaluation.truth import read_truth
from fcos_lidar_jax.types import Detections

TOKENS = ("a", "b", "c")


def box(token="b", **changes):
    plain = {
        "sample_token": token,
        "translation": [1.0, 2.0, 3.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.5, 0.0],
        "detection_name": "car",
        "detection_score": 0.5,
        "attribute_name": "vehicle.moving",
    }
    return {name: value for name, value in {**plain, **changes}.items() if value != "left out"}


def document(**changes):
    """A results file that is valid except for the changes to the second box of sample b."""
    boxes = {"a": [], "b": [box(), box(**changes)], "c": [box("c")]}
    return {"meta": {flag: False for flag in USE_FLAGS}, "results": boxes}


BOXES = {
    "unknown class": ({"detection_name": "tram"}, r"detection_name: got 'tram', expected one of car, truck"),
    "infinite score": ({"detection_score": float("inf")}, "detection_score: expected `float`, got `str`"),
    "negative score": ({"detection_score": -0.5}, r"detection_score: got -0\.5, expected a finite number"),
    "zero size": ({"size": [2, 0, 1]}, r"size: got \[2\.0, 0\.0, 1\.0\], expected three positive lengths"),
    "NaN size": ({"size": [2, float("nan"), 1]}, r"size\[1\]: expected `float`, got null or NaN"),
    "far away": ({"translation": [1e300, 0, 0]}, r"translation: got .*, expected numbers of at most 1e\+08"),
    "vanishing quaternion": ({"rotation": [1e-200, 0, 0, 0]}, "rotation: got .*, expected a nonzero quaternion"),
    "fast": ({"attribute_name": "fast"}, "attribute_name: got 'fast', expected one of cycle.* or nothing"),
    "other sample": ({"token": "a"}, "sample_token: got 'a', expected 'b'"),
}


def spelt(field, text):
    """A results file with arbitrary bytes as the value of a field."""
    return json.dumps(document(**{field: "here"})).encode().replace(b'"here"', text)


def results_of(empty="", **samples):
    return {"meta": {}, "results": {**{token: [] for token in empty}, **samples}}


FILES = {
    **{name: (document(**changes), f"sample b: box 1: {message}") for name, (changes, message) in BOXES.items()},
    "missing tokens": (results_of("a"), "sample b and 1 more: missing"),
    "extra": (results_of("abcde"), "sample d and 1 more: not expected: expected the 3 samples of split 'val'"),
    "501 boxes": (results_of("bc", a=[box("a")] * 501), "sample a: box 500: got 501 boxes, expected at most 500"),
    "twice": (b'{"meta": {}, "results": {"a": [], "b": [], "b" : []}}', "results: sample b: occurs twice"),
    "box a list": (results_of(a=[[]]), "sample a: box 0: expected `object`, got `array`"),
    "cut": (json.dumps(document()).encode()[:-9], "not JSON: .*truncated"),
    "too large": (spelt("detection_score", b"1e999"), "sample b: (box 1: detection_score: )?.*out of range"),
    "a broken letter": (spelt("detection_name", b'"x\xffz"'), "sample b: not JSON: "),
    "nested in a box": (spelt("size", b"[" * 100_000 + b"]" * 100_000), "(sample b: )?not JSON: .*recursion"),
    "empty": (b"", "not JSON: .*truncated"),
}


@pytest.mark.parametrize("name", FILES)
def test_invalid_boxes_and_files_are_named_in_one_line(name, tmp_path):
    source, message = FILES[name]
    file = tmp_path / "results.json"
    file.write_bytes(source if isinstance(source, bytes) else json.dumps(source).encode())
    with pytest.raises(ValueError, match=rf"^{re.escape(str(file))}: {message}") as error:
        read_results(file, TOKENS, of="split 'val'")
    assert "\n" not in str(error.value)


def test_irregularities_are_accepted_with_a_warning(tmp_path):
    file = tmp_path / "results.json"
    source = document(rotation=[0.0, 0.0, 0.0, 3.0], velocity=[float("nan"), 1.0])
    source["results"]["c"][0] |= {"velocity": None, "rotation": [0, 2, 0, 0], "detection_score": 1, "extra": 0}
    source["meta"] = {"use_lidar": True, "use_map": "no", "method": "a [NaN, Infinity] b"}
    file.write_text(json.dumps(source), encoding="utf-8-sig")
    results = read_results(file, TOKENS)
    assert results.meta == source["meta"]  # NaN within a string is unchanged
    np.testing.assert_allclose(results.boxes.yaw, [0, np.pi, 0])
    np.testing.assert_array_equal(results.boxes.velocity, [[0.5, 0], [np.nan, 1], [np.nan, np.nan]])
    meta, rotation, order = results.warnings
    assert "meta: use_camera, use_radar, use_map, use_external: expected true or false, which" in meta
    assert "sample b: box 1: rotation: normalised, got a quaternion of norm 3, and 1 more" in rotation
    assert "sample c: box 0: rotation: upside down, got [0.0, 2.0, 0.0, 0.0], expected w, x, y, z" in order
    assert read_results(document(), TOKENS).warnings == ()
    [line] = read_results(document(attribute_name="pedestrian.moving"), TOKENS).warnings  # as in the devkit
    assert line.endswith("sample b: box 1: attribute_name: counted as wrong, got 'pedestrian.moving' for a car")


def truth(**changes):
    plain = box(sample_token="left out", detection_score="left out", num_pts=3)
    return {"a": {"ego_translation": [0, 0, 0], "boxes": [plain, {**plain, **changes}]}}


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (truth(detection_name="animal"), "sample a: box 1: detection_name: got 'animal', expected one of c.*rack"),
        (truth(num_pts=-2), "sample a: box 1: num_pts: got -2, expected a count, or -1 for unknown"),
        ({"a": {"boxes": []}}, "sample a: object missing required field `ego_translation`"),
        ({"a": {"ego_translation": [0, 0, float("nan")], "boxes": []}}, r"sample a: ego_translation\[2\]"),
        ({"a": {"ego_translation": [0, 0, 1e200], "boxes": []}}, r"sample a: ego_translation\[2\]"),
        ({}, "got no samples, expected at least one"),
    ],
)
def test_invalid_truth_is_named(source, message, tmp_path):
    file = tmp_path / "truth.json"
    file.write_text(json.dumps(source))
    with pytest.raises(ValueError, match=rf"^{re.escape(str(file))}: {message}"):
        read_truth(file)


def found(number=40, valid=30):
    rng = np.random.default_rng(0)
    boxes = random_boxes(rng, number)
    boxes[:, 7:] *= 0.1  # some are slow enough to count as stationary
    scores = np.sort(rng.random(number).astype(np.float32))[::-1]
    labels = rng.integers(0, 10, number, np.int32)
    return Detections(boxes, scores, labels, np.arange(number) < valid, np.int32(0))


def test_detections_are_transformed_to_the_global_frame(tmp_path):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.02, -0.03]).as_matrix()
    pose[:3, 3] = [600, 1600, 2]
    d = found()
    with ResumeLog(tmp_path / "resume_log", "x") as resume_log:
        for token in TOKENS:
            resume_log.add(token, result_entries(d, token, pose) if token != "a" else [])
        write_results(tmp_path / "results.json", ((token, resume_log.entry(token)) for token in TOKENS))
    results = read_results(tmp_path / "results.json", TOKENS)
    assert results.warnings == ()
    assert results.meta == {flag: flag == "use_lidar" for flag in USE_FLAGS}
    assert results.boxes.sample.tolist() == [1] * 30 + [2] * 30
    own = results.boxes.take(slice(0, 30))
    boxes, turn = np.asarray(d.boxes, np.float64)[:30], pose[:3, :3]
    np.testing.assert_allclose(own.translation, boxes[:, :3] @ turn.T + pose[:3, 3], atol=1e-9)
    ahead = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(30)]) @ turn.T
    np.testing.assert_allclose(np.exp(1j * own.yaw), np.exp(1j * np.arctan2(ahead[:, 1], ahead[:, 0])), atol=1e-9)
    np.testing.assert_allclose(own.velocity, boxes[:, 7:9] @ turn[:2, :2].T, atol=1e-9)
    np.testing.assert_allclose(own.size, boxes[:, [4, 3, 5]])
    np.testing.assert_array_equal(own.score, np.asarray(d.scores)[:30])
    entry = json.loads((tmp_path / "results.json").read_text())["results"]["b"][0]
    full = Rotation.from_quat(entry["rotation"], scalar_first=True).as_matrix()
    expected = turn @ Rotation.from_euler("z", boxes[0, 6]).as_matrix()
    np.testing.assert_allclose(full, expected, atol=1e-12)
    assert entry["attribute_name"] == attribute_of(entry["detection_name"], float(np.hypot(*boxes[0, 7:9])))


def test_entries_are_the_best_500_boxes():
    entries = result_entries(found(600, 600), "a", np.eye(4))
    assert len(read_results(results_of(a=entries), ("a",)).boxes) == len(entries) == 500
    assert entries[-1]["detection_score"] == float(found(600, 600).scores[499])
    assert result_entries(found(5, 0), "a", np.eye(4)) == []


def test_an_interrupted_command_says_that_it_resumes_if_something_is_in_the_log(tmp_path, capsys):
    def fail(resume_log, error, *tokens):
        for token in tokens:
            resume_log.add(token, [])
        raise error

    said = "the same command resumes\n"
    for error, tokens, expected in (
        (KeyboardInterrupt, "", ""),
        (ValueError, "a", said),
        (KeyboardInterrupt, "b", said),
        (SystemExit, "", said),
    ):
        with pytest.raises(error), ResumeLog(tmp_path / "resume_log", "x") as resume_log:
            fail(resume_log, error, *tokens)
        assert capsys.readouterr().err == expected


def test_a_resume_log_survives_interruptions(tmp_path):
    file = tmp_path / "resume_log"
    with ResumeLog(file, "one") as resume_log:
        resume_log.add("a", [{"x": 1}])
        resume_log.add("b", [])
        assert file.read_bytes().count(b"\n") == 3  # whole, should the process be killed now
    whole = file.read_bytes()
    for cut in range(len(whole)):
        file.write_bytes(whole[:cut])
        with ResumeLog(file, "one") as resume_log:
            assert len(resume_log) == max(whole[:cut].count(b"\n") - 1, 0)
            for token, entries in (("a", [{"x": 1}]), ("b", [])):
                if token not in resume_log:
                    resume_log.add(token, entries)
        assert file.read_bytes() == whole
    with ResumeLog(file, "one") as resume_log:
        assert [resume_log.entry(token) for token in "ba"] == [b"[]", b'[{"x": 1}]']
    for damaged in (b'{"a":', b"[1]", b'"a\xff"', b"[" * 100_000):
        file.write_bytes(whole + damaged + b"\t[]\n" + b'"c"\t[]\n')
        with ResumeLog(file, "one") as resume_log:
            assert list(resume_log.places) == ["a", "b"]
        assert file.read_bytes() == whole
    with ResumeLog(file, "another") as resume_log:
        assert len(resume_log) == 0
    with ResumeLog(file, "one") as resume_log:  # opening without adding changed nothing
        assert list(resume_log.places) == ["a", "b"]
    with ResumeLog(file, "another") as resume_log:
        resume_log.add("c", [])
        assert resume_log.entry("c") == b"[]"
    with ResumeLog(file, "one") as resume_log:
        assert len(resume_log) == 0
