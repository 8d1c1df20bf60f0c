"""What several commands refuse, in the same words."""

from pathlib import Path


def check_at_least(args: object, least: int, *options: str) -> None:
    """Refuse numbers below a bound; options that are None were not given.

    Raises:
        ValueError: naming the option as it is typed.
    """
    for name in options:
        value = getattr(args, name)
        if value is not None and value < least:
            raise ValueError(f"--{name.replace('_', '-')}: got {value}, expected at least {least}")


def check_out_folder(out: Path) -> None:
    """Refuse a file where ``--out`` is to be a folder.

    Raises:
        ValueError: naming the file.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out: {out}: found a file, expected a folder")
