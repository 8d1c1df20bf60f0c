"""The nuScenes benchmark on keyframes in memory, without a results file."""

from collections.abc import Iterable, Sequence

from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.evaluation.metrics import Evaluation, evaluate
from fcos_lidar_jax.evaluation.results import LIDAR_META, read_results, result_entries
from fcos_lidar_jax.evaluation.truth import split_truth
from fcos_lidar_jax.types import Detections


def evaluate_keyframes(
    found: Iterable[Detections], data: NuScenes, tokens: Sequence[str], classes: Sequence[str]
) -> Evaluation:
    """Evaluate detections in keyframes with the benchmark's metrics, equal to those of their results file.

    Args:
        found: NumPy detections of each keyframe, in its LiDAR frame.
        data, tokens: data set and tokens of the keyframes.
        classes: class names by label, all from the benchmark.
    """
    results = {
        token: result_entries(boxes, token, data.sensor_to_global(token), classes)
        for token, boxes in zip(tokens, found, strict=True)
    }
    boxes = read_results({"meta": LIDAR_META, "results": results}, tuple(tokens)).boxes
    return evaluate(boxes, split_truth(data, tokens))
