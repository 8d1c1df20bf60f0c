"""nuScenes' benchmark on keyframes at hand, without a results file on disk."""

from collections.abc import Iterable, Sequence

from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.evaluation.results import LIDAR_META, read_results, result_entries
from fcos_lidar_jax.evaluation.truth import split_truth
from fcos_lidar_jax.types import Detections


def evaluate_keyframes(
    found: Iterable[Detections], data: NuScenes, tokens: Sequence[str], classes: Sequence[str]
) -> Evaluation:
    """The benchmark's numbers for detections in keyframes, the same as those of their results file.

    Args:
        found: NumPy arrays, of each keyframe, in its LiDAR frame.
        data, tokens: data set and its keyframes.
        classes: names that the labels index, of the benchmark's.
    """
    results = {
        token: result_entries(boxes, token, data.sensor_to_global(token), classes)
        for token, boxes in zip(tokens, found, strict=True)
    }
    boxes = read_results({"meta": LIDAR_META, "results": results}, tuple(tokens)).boxes
    return evaluate(boxes, split_truth(data, tokens))
