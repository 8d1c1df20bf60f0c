"""A detector run over keyframes: batched, loaded ahead, restartable."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import jax
import numpy as np

from fcos_lidar_jax.config import config_to_json
from fcos_lidar_jax.data.batching import empty_batch, fill_points
from fcos_lidar_jax.data.nuscenes import NuScenes
from fcos_lidar_jax.data.nuscenes.reader import NuScenesFrames
from fcos_lidar_jax.evaluation.journal import Journal
from fcos_lidar_jax.evaluation.submission import result_entries, write_results
from fcos_lidar_jax.inference import make_detect
from fcos_lidar_jax.models import build_detector
from fcos_lidar_jax.sensors import sensor_to_json
from fcos_lidar_jax.training import Checkpoint
from fcos_lidar_jax.types import Batch

_AHEAD = 2
"""Batches that are read while one is on the device."""


def detect_samples(
    checkpoint: Checkpoint,
    data: NuScenes,
    tokens: Sequence[str],
    results: Path,
    *,
    batch_size: int = 1,
    report: Callable[[int], None] = lambda done: None,
) -> int:
    """Detect in every keyframe and write the official results file.

    What is done is kept in a journal beside the file, by which a run that was interrupted goes on; it is removed
    when the file is written. The batch size does not change what is found.

    Args:
        checkpoint: the detector.
        data: where the keyframes are.
        tokens: of the keyframes.
        results: the file to write.
        batch_size: keyframes on the device at once.
        report: told how many keyframes are done.

    Returns:
        how many points found no room in the detector's fixed number.
    """
    config = checkpoint.config
    frames = NuScenesFrames(
        data,
        tuple(tokens),
        num_sweeps=config.num_sweeps,
        remove_close=config.projection.remove_close,
        close_m=config.projection.close_m,
    )
    detect = jax.jit(
        jax.vmap(make_detect(build_detector(config, checkpoint.sensor), config, checkpoint.sensor), (None, 0, 0))
    )
    file, overflow = results.with_name(f"{results.stem}.journal"), 0
    with Journal(file, fingerprint(checkpoint, data, tokens)) as journal:
        report(len(journal))
        todo = [i for i, token in enumerate(tokens) if token not in journal]
        for rows, batch, lost in _batches(frames, todo, batch_size, config.max_points):
            overflow += lost
            found = jax.device_get(detect(checkpoint.variables, batch.points, batch.valid))
            for slot, row in enumerate(rows):
                one = jax.tree.map(lambda leaf, slot=slot: leaf[slot], found)
                journal.add(tokens[row], result_entries(one, tokens[row], data.sensor_to_global(tokens[row])))
            report(len(journal))
        write_results(results, journal.entries(tokens))
    file.unlink()
    return overflow


def _batches(
    frames: NuScenesFrames, rows: Sequence[int], size: int, max_points: int
) -> Iterator[tuple[Sequence[int], Batch, int]]:
    """Keyframes, their points padded to one shape, and how many points were lost; read ahead in threads."""

    def load(chosen: Sequence[int]) -> tuple[Sequence[int], Batch, int]:
        clouds = [frames.points(row) for row in chosen]
        batch = empty_batch(size, max_points=max_points, max_boxes=0, columns=clouds[0].shape[1])
        none = np.zeros(0, np.int64)
        return chosen, batch, sum(fill_points(batch, i, [cloud], none) for i, cloud in enumerate(clouds))

    chunks = (rows[i : i + size] for i in range(0, len(rows), size))
    with ThreadPoolExecutor(_AHEAD) as pool:
        waiting = [pool.submit(load, chunk) for chunk in islice(chunks, _AHEAD)]
        while waiting:
            ready = waiting.pop(0).result()
            waiting += [pool.submit(load, chunk) for chunk in islice(chunks, 1)]
            yield ready


def fingerprint(checkpoint: Checkpoint, data: NuScenes, tokens: Sequence[str]) -> str:
    """What detections follow from: weights, configuration, sensor, data and keyframes."""
    digest = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves(checkpoint.variables):
        digest.update(np.ascontiguousarray(leaf).data)
    described = config_to_json(checkpoint.config), sensor_to_json(checkpoint.sensor)
    place = str(data.root.resolve()), data.version, data.allow_missing_sweeps, list(tokens)
    digest.update(json.dumps([described, place], sort_keys=True).encode())
    return digest.hexdigest()
