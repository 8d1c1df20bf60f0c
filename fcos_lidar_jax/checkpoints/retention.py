"""The checkpoints of a run: the newest ones, to resume from, and the best."""

import shutil
import sys
from importlib.resources import files
from pathlib import Path

from fcos_lidar_jax.checkpoints.storage import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_state,
    read_description,
    save_checkpoint,
    save_score,
)
from fcos_lidar_jax.types import TrainState

CHECKPOINTS = "checkpoints"  # Folder of the checkpoints in a run's folder.
BEST = "best"  # Below a run's folder: name for its best checkpoint.


class Checkpoints:
    """Checkpoints below a folder, one a step; the ``keep`` newest are kept, and the one of the best score."""

    def __init__(self, folder: Path, *, keep: int = 2) -> None:
        self.folder, self.keep = folder, keep

    def save(self, checkpoint: Checkpoint, state: TrainState) -> Path:
        """Write a checkpoint, then remove what is no longer kept.

        Raises:
            OSError: it cannot be written; the others stay.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{checkpoint.step:08d}"
        save_checkpoint(path, checkpoint, state=state)
        for leftover in self.folder.glob(".*"):  # of saves that were killed
            shutil.rmtree(leftover, ignore_errors=True)
        self._prune(path)
        return path

    def record_score(self, step: int, score: float) -> None:
        """Record what the checkpoint of a step scored, then remove what is no longer kept."""
        path = self.folder / f"{step:08d}"
        save_score(path, score)
        self._prune(path)

    def _prune(self, path: Path) -> None:
        """Remove all but the best and the newest up to a checkpoint."""
        # Later ones are damaged: the run went back to before them. They would be taken for the newest.
        paths, passed_over = ([p for p in self.paths() if (p > path) == later] for later in (False, True))
        for old in {*passed_over, *paths[: -self.keep]} - {best_of(paths)}:
            shutil.rmtree(old)

    def paths(self) -> list[Path]:
        """All checkpoints, the oldest first, unread."""
        return sorted(path for path in self.folder.glob("[0-9]*") if path.is_dir())

    def newest(self, like: TrainState) -> tuple[Checkpoint, TrainState] | None:
        """The newest checkpoint that is whole, with its state; None where there are none.

        A damaged one is passed over with a warning on standard error. ``like`` is any state of the same run.

        Raises:
            CheckpointError: there are some, and all are damaged.
        """
        paths = self.paths()
        for path in reversed(paths):
            try:
                return load_checkpoint(path), load_state(path, like)
            except CheckpointError as error:
                print(f"warning: {error}: going back to the checkpoint before", file=sys.stderr)
        if paths:
            raise CheckpointError(f"{self.folder}: all {len(paths)} checkpoints are damaged, expected a whole one")
        return None


def best_of(paths: list[Path]) -> Path | None:
    """The checkpoint of the highest score, of equal ones the newest; None where none has one."""
    scored = []
    for path in paths:
        try:
            score = read_description(path).get("score")
        except CheckpointError:
            continue
        if score is not None:
            scored.append((score, path))
    return max(scored)[1] if scored else None


def find_checkpoint(folder: Path) -> Path:
    """The checkpoint that a path or a name stands for.

    A checkpoint's folder stands for itself, a run's for its last checkpoint, ``RUN/best`` for the one that scored
    best while it was trained; or it is the name of weights that come with the package, where there is no
    folder of that name.

    >>> find_checkpoint(Path("nowhere"))
    PosixPath('nowhere')
    """
    if not folder.exists():
        shipped = shipped_checkpoints()
        run_best = best_of(Checkpoints(folder.parent / CHECKPOINTS).paths()) if folder.name == BEST else None
        return run_best or shipped.get(str(folder), folder)
    paths = Checkpoints(folder / CHECKPOINTS).paths()
    return paths[-1] if paths else folder


def shipped_checkpoints() -> dict[str, Path]:
    """Name -> folder of the checkpoints that come with the package.

    >>> "quickstart" in shipped_checkpoints()
    True
    """
    folder = Path(str(files("fcos_lidar_jax") / "weights"))
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()} if folder.is_dir() else {}
