"""What the fields of a command declare about its options, checked before it begins to work."""

import dataclasses
import enum
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

from fcos_lidar_jax.checkpoints.retention import find_checkpoint
from fcos_lidar_jax.config import Config
from fcos_lidar_jax.data.folder import belongs_to_own_data
from fcos_lidar_jax.data.point_files import ENDINGS
from fcos_lidar_jax.data.ros_bags import BAG_ENDINGS
from fcos_lidar_jax.fields import Bounds
from fcos_lidar_jax.files import check_writable, import_extra, local_path

_POSITIONAL = {"files": "INPUT", "source": "SOURCE"}


class Output(enum.Enum):
    """The option is a path to write to."""

    FILE = "file"
    CLOUD = "cloud"  # a file that may replace a point file
    FOLDER = "folder"
    RESULT = "result"  # a file, or a folder for --output-format kitti


@dataclasses.dataclass(frozen=True)
class Or:
    """The option is required, unless another one is given."""

    other: str


@dataclasses.dataclass(frozen=True)
class Needs:
    """The option is only for calls with another one, or with a value of it."""

    other: str
    value: str = ""


@dataclasses.dataclass(frozen=True)
class Excludes:
    """The option is not for calls with any of some others, because of ``why``."""

    others: tuple[str, ...]
    why: str


@dataclasses.dataclass(frozen=True)
class _Option:
    value: Any
    is_given: bool
    rules: tuple[Any, ...]

    @property
    def output(self) -> Output | None:
        return next((rule for rule in self.rules if isinstance(rule, Output)), None)

    def paths(self) -> list[Path]:
        values = self.value if isinstance(self.value, tuple) else (self.value,)
        return [value for value in values if isinstance(value, Path)]


def check_options(command: Any) -> None:
    """Check every option of a command by the rules of its field: :class:`~.fields.Bounds` and the classes above.

    Raises ValueError, or OSError for an output that cannot be written. Exits with 2 if an option is missing.
    """
    options = dict(_options(command))
    for name, option in options.items():
        _check_rules(name, options)
        for value in (option.value, *option.paths()):
            if isinstance(value, str | Path):
                local_path(value)
    if "rrd" in options and options["rrd"].is_given:
        import_extra("rerun", "viz", "--rrd: ")
    _check_outputs(options)


def _options(command: Any) -> Iterator[tuple[str, _Option]]:
    """The options by their fields, with those of nested groups. Configurations check themselves."""
    hints = get_type_hints(type(command), include_extras=True)
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if dataclasses.is_dataclass(value):
            yield from () if isinstance(value, Config) else _options(value)
        else:
            rules = getattr(hints[field.name], "__metadata__", ())
            yield field.name, _Option(value, value not in (field.default, None, ()), rules)


def _check_rules(name: str, options: dict[str, _Option]) -> None:
    option = options[name]
    for rule in option.rules:
        match rule:
            case Bounds() if option.value is not None and not rule.hold(option.value):
                expected = str(rule)
            case Or(other) if not option.is_given and not options[other].is_given:
                exit_without(option_name(name), option_name(other))
            case Needs(other, value) if option.is_given and not _has(options[other], value):
                expected = f"only with {option_name(other)} {value}".rstrip()
            case Excludes(others, why) if option.is_given and any(options[other].is_given for other in others):
                beside = next(other for other in others if options[other].is_given)
                expected = f"none with {option_name(beside)}: {why}"
            case _:
                continue
        raise ValueError(f"{option_name(name)}: got {option.value}, expected {expected}")


def _has(option: _Option, value: str) -> bool:
    return option.value == value if value else option.is_given


def exit_without(option: str, other: str | None = None) -> NoReturn:
    """Exit with 2, like tyro without a required option."""
    more = f", or {other}" if other else ""
    print(f"fcos-lidar: error: {option}: got none, expected one{more}", file=sys.stderr)
    sys.exit(2)


def option_name(field: str) -> str:
    """Name of a field's option as it is typed, such as ``--batch-size``."""
    return _POSITIONAL.get(field, f"--{field.replace('_', '-')}")


def _check_outputs(options: dict[str, _Option]) -> None:
    """Check that the outputs can be written, and replace neither inputs, the checkpoint, nor one another."""
    keep = [path for option in options.values() if option.output is None for path in option.paths()]
    checkpoints = options["checkpoint"].paths() if "checkpoint" in options else []
    for name, option in options.items():
        for out in option.paths() if option.output else ():
            for checkpoint in checkpoints:
                _check_outside(option_name(name), out, checkpoint)
            is_result = option.output is Output.RESULT
            if option.output is Output.FOLDER or (is_result and options["output_format"].value == "kitti"):
                check_writable(out / ".lock")
            else:
                check_out_file(option_name(name), out, keep)
                recorded = out.is_file() and out.name.lower().endswith((*ENDINGS, *BAG_ENDINGS))
                if option.output is not Output.CLOUD and recorded:
                    found = "found a point file or recording"
                    raise ValueError(f"{option_name(name)}: {out}: {found}, expected another one")
            keep.append(out)


def check_out_file(option: str, out: Path, keep: Iterable[Path]) -> None:
    """Reject an output that is one of the files to ``keep`` or of own data, or not writable."""
    for other in keep:
        if out.resolve() == other.resolve() or (out.exists() and other.exists() and out.samefile(other)):
            raise ValueError(f"{option}: {out}: the same file as {other}, expected another one")
    if belongs_to_own_data(out):
        raise ValueError(f"{option}: {out}: the place of a file of own data, expected another one")
    check_writable(out)


def _check_outside(option: str, out: Path, checkpoint: Path) -> None:
    """Reject an output inside of the checkpoint's folder, over an exported file, or with the checkpoint's name."""
    place = out.resolve()
    inside = find_checkpoint(checkpoint).resolve() in (place, *place.parents)
    # A later command would take an output with the name of shipped weights for the detector.
    if inside or (place == checkpoint.resolve() and not checkpoint.exists()):
        raise ValueError(f"{option}: {out}: the place of the checkpoint, expected another one")
