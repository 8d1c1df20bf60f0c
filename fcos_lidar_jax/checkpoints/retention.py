"""The checkpoints of a run: the newest, to resume from, and the best.

Orbax's ``CheckpointManager`` is not used: it restores corrupt arrays without an error, does not fall back to an
older checkpoint, and lets two processes write into one folder (tried with Orbax 0.12).
"""

import contextlib
import shutil
import sys
import tempfile
from pathlib import Path

from fcos_lidar_jax.checkpoints.storage import (
    Checkpoint,
    CheckpointError,
    is_checkpoint,
    read_checkpoint,
    read_description,
    read_state,
    save_checkpoint,
    save_score,
    shipped_checkpoints,
    verify,
)
from fcos_lidar_jax.files import local_path
from fcos_lidar_jax.types import TrainState

CHECKPOINTS = "checkpoints"  # folder of the checkpoints in the folder of a run
BEST = "best"  # RUN/best stands for the best checkpoint of a run


class Checkpoints:
    """Folder of checkpoints, at most one per step; keeps the ``keep`` newest and the one with the best score."""

    def __init__(self, folder: Path, *, keep: int = 2) -> None:
        self.folder, self.keep = folder, keep

    def save(self, checkpoint: Checkpoint, state: TrainState) -> None:
        """Write a checkpoint, then remove old ones; if writing fails, the other checkpoints are unchanged."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{checkpoint.step:08d}"
        if path.is_dir() and not is_checkpoint(path):  # Damaged: the run resumed before it.
            self._remove(path)
        save_checkpoint(path, checkpoint, state=state)
        for leftover in self.folder.glob(".*"):  # from saves that were killed
            shutil.rmtree(leftover, ignore_errors=True)
        self._prune(path)

    def record_score(self, step: int, score: float) -> None:
        """Record the score of the checkpoint of a step, then remove old checkpoints."""
        path = self.folder / f"{step:08d}"
        save_score(path, score)
        self._prune(path)

    def _prune(self, newest: Path) -> None:
        # The run resumed before any later checkpoints because they are corrupt. They must not count as the newest.
        paths, corrupt = ([p for p in self.paths() if (p > newest) == later] for later in (False, True))
        for old in {*corrupt, *paths[: -self.keep]} - {best_of(paths)}:
            self._remove(old)

    def _remove(self, path: Path) -> None:
        # Network file systems cannot remove the folder while another process reads it: the next save does.
        leftover = Path(tempfile.mkdtemp(dir=self.folder, prefix="."))
        path.rename(leftover / path.name)
        shutil.rmtree(leftover, ignore_errors=True)

    def paths(self) -> list[Path]:
        """All checkpoints, oldest first, without verification."""
        return sorted(path for path in self.folder.glob("[0-9]*") if path.is_dir())

    def newest(self, like: TrainState) -> TrainState | None:
        """The state of the newest intact checkpoint; None if the folder has no checkpoints.

        Corrupt checkpoints are skipped with a warning on standard error; if all are corrupt, a CheckpointError
        says so. An intact checkpoint that cannot be read, for lack of memory for example, is an error and not
        skipped, because the next save would remove it. ``like`` is any state of the same run.
        """
        paths = self.paths()
        for path in reversed(paths):
            try:
                verify(path)
            except CheckpointError as error:
                print(f"warning: {error}: going back to the checkpoint before", file=sys.stderr)
            else:
                return read_state(path, like)
        if paths:
            raise CheckpointError(f"{self.folder}: all {len(paths)} checkpoints are damaged, expected a whole one")
        return None


def best_of(paths: list[Path]) -> Path | None:
    """The checkpoint with the highest score, the newest of equal ones; None if no checkpoint has a score."""
    scored = []
    for path in paths:
        with contextlib.suppress(CheckpointError):
            if (score := read_description(path).get("score")) is not None:
                scored.append((score, path))
    return max(scored)[1] if scored else None


def find_checkpoint(folder: Path) -> Path:
    """The checkpoint that a path or name stands for.

    The folder of a checkpoint stands for itself, the folder of a run for its last checkpoint, and ``RUN/best`` for
    the checkpoint with the best score. The name of shipped weights stands for them unless a folder has that name.

    Raises:
        CheckpointError: ``RUN/best`` of a run whose checkpoints have no score.
    """
    if not local_path(folder).exists():
        of_run = Checkpoints(folder.parent / CHECKPOINTS).paths() if folder.name == BEST else []
        if not of_run:
            return shipped_checkpoints().get(str(folder), folder)
        if (best := best_of(of_run)) is None:
            how = "train gives one on --val-split, every --evaluate-every steps"
            raise CheckpointError(f"{folder}: found no checkpoint of this run with a score, expected one: {how}")
        return best
    paths = Checkpoints(folder / CHECKPOINTS).paths()
    return paths[-1] if paths else folder


def load_checkpoint(checkpoint: str | Path) -> Checkpoint:
    """Read a checkpoint after checking the hashes of its files and the shapes of its arrays.

    ``checkpoint`` is a path or a name, see :func:`find_checkpoint`.

    Raises:
        CheckpointError: names the folder, what was found and what was expected.

    >>> load_checkpoint("quickstart").sensor.name
    'short_range'
    """
    return read_checkpoint(find_checkpoint(Path(checkpoint)))


def load_state(checkpoint: str | Path, like: TrainState) -> TrainState:
    """Read the state of a training, bit-identical to the saved one.

    ``checkpoint`` is a path or a name, see :func:`find_checkpoint`; ``like`` is any state of the same run.

    Raises:
        CheckpointError: see :func:`load_checkpoint`; also if the checkpoint has no state.
    """
    return read_state(find_checkpoint(Path(checkpoint)), like)
