"""Checks that several commands make before they begin to work. Each raises ValueError or OSError."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.data.folder import belongs_to_own_data
from fcos_lidar_jax.fields import check
from fcos_lidar_jax.files import check_writable


def option_name(field: str) -> str:
    """Name of a field's option as it is typed, such as ``--batch-size``."""
    return f"--{field.replace('_', '-')}"


def check_at_least(args: object, least: int, *fields: str) -> None:
    """Reject numbers below a bound; None passes."""
    for field in fields:
        value = getattr(args, field)
        check(value is None or value >= least, option_name(field), value, f"at least {least}")


def check_score(args: Any) -> None:
    """Reject a ``min_score`` outside of 0 to 1."""
    if args.min_score is not None and not 0 <= args.min_score <= 1:
        raise ValueError(f"--min-score: got {args.min_score:g}, expected a score of 0 to 1")


def check_out_folder(out: Path, option: str = "--out") -> None:
    """Reject a file, and a folder that cannot be written to."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"{option}: {out}: found a file, expected a folder")
    check_writable(out / ".lock")


def check_out_file(option: str, out: Path, keep: Iterable[Path]) -> None:
    """Reject an output that is one of the files to ``keep`` or of own data, no regular file, or not writable."""
    for other in keep:
        if out.resolve() == other.resolve() or (out.exists() and other.exists() and out.samefile(other)):
            raise ValueError(f"{option}: {out}: the same file as {other}, expected another one")
    if belongs_to_own_data(out):
        raise ValueError(f"{option}: {out}: the place of a file of own data, expected another one")
    check_writable(out)


def check_outside(option: str, out: Path, checkpoint: Path) -> None:
    """Reject an output inside of the checkpoint's folder, over an exported file, or with the checkpoint's name."""
    place = out.resolve()
    if find_checkpoint(checkpoint).resolve() in (place, *place.parents):
        raise ValueError(f"{option}: {out}: inside of the checkpoint, expected a path elsewhere")
    if place == checkpoint.resolve() and not checkpoint.exists():  # a later command would take it for the detector
        raise ValueError(f"{option}: {out}: the name of the checkpoint, expected another one")


def check_outputs(checkpoint: Path, keep: Iterable[Path], **outputs: Path | None) -> None:
    """Check output files with :func:`check_outside` and :func:`check_out_file`; all of them must differ."""
    kept = list(keep)
    for field, out in outputs.items():
        if out is not None:
            check_outside(option_name(field), out, checkpoint)
            check_out_file(option_name(field), out, kept)
            kept.append(out)
