"""What several commands refuse, in the same words."""

from collections.abc import Iterable
from pathlib import Path

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.files import check_writable


def check_at_least(args: object, least: int, *options: str) -> None:
    """Refuse numbers below a bound; options that are None were not given.

    Raises:
        ValueError: naming the option as it is typed.
    """
    for name in options:
        value = getattr(args, name)
        if value is not None and value < least:
            raise ValueError(f"--{name.replace('_', '-')}: got {value}, expected at least {least}")


def check_out_folder(out: Path, option: str = "--out") -> None:
    """Refuse what cannot be a folder to write to, before any work is done.

    Raises:
        ValueError: naming the option and the file.
        OSError: it cannot be written to.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"{option}: {out}: found a file, expected a folder")
    check_writable(out / ".lock")


def check_out_file(option: str, out: Path, keep: Iterable[Path]) -> None:
    """Refuse a place that no file can be written to, before any work is done.

    Args:
        option: as it is typed.
        out: its value.
        keep: files that the command reads or writes besides.

    Raises:
        ValueError: it is one of those to keep.
        OSError: it is a folder, a device or a link, or cannot be written.
    """
    for other in keep:
        if out.resolve() == other.resolve() or (out.exists() and other.exists() and out.samefile(other)):
            raise ValueError(f"{option}: {out}: the same file as {other}, expected another one")
    check_writable(out)


def check_outside(option: str, out: Path | None, checkpoint: Path) -> None:
    """Refuse to write into the detector that is used: into a checkpoint's folder, or over an exported file.

    Args:
        option: as it is typed.
        out: its value; None where it was not given.
        checkpoint: a path or a name, see :func:`find_checkpoint`.

    Raises:
        ValueError: naming the option and the place.
    """
    if out is None:
        return
    place = out.resolve()
    if find_checkpoint(checkpoint).resolve() in (place, *place.parents):
        raise ValueError(f"{option}: {out}: found a place in the checkpoint, expected one elsewhere")
    if place == checkpoint.resolve() and not checkpoint.exists():  # It would stand for the detector the next time.
        raise ValueError(f"{option}: {out}: found the name of the checkpoint, expected another one")
