"""Fields of frozen dataclasses: checks at construction, and conversion from parsed JSON."""

import dataclasses
import difflib
import itertools
import math
from collections.abc import Collection, Iterable, Mapping
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints


@dataclasses.dataclass(frozen=True)
class Bounds:
    """The numbers that a field of a :class:`Checked` dataclass accepts, declared by ``Annotated``.

    They hold for each entry of a tuple, and for any value but None. Infinities are never accepted.
    """

    low: float
    high: float = math.inf
    above: bool = False  # without ``low`` itself
    below: bool = False  # without ``high`` itself
    empty: bool = False  # also an empty tuple
    ascending: bool = False  # no entry is below the one before it

    def hold(self, value: Any) -> bool:
        numbers = value if isinstance(value, tuple) else (value,)
        low = all(number > self.low or (number == self.low and not self.above) for number in numbers)
        closed = not self.below and self.high < math.inf
        high = all(number < self.high or (number == self.high and closed) for number in numbers)
        in_order = not self.ascending or all(a <= b for a, b in itertools.pairwise(numbers))
        return low and high and in_order and (self.empty or len(numbers) > 0)

    def __str__(self) -> str:
        if self.ascending:
            return f"ascending numbers, each {dataclasses.replace(self, ascending=False)}"
        if self.high < math.inf:
            return f"within {'(' if self.above else '['}{self.low:g}, {self.high:g}{')' if self.below else ']'}"
        if isinstance(self.low, int):
            return f"at least {self.low}"
        return f"a finite number {'above' if self.above else 'of at least'} {self.low:g}"


Natural = Annotated[int, Bounds(0)]
Count = Annotated[int, Bounds(1)]
Counts = Annotated[tuple[int, ...], Bounds(1)]
Amount = Annotated[float, Bounds(0.0)]
Positive = Annotated[float, Bounds(0.0, above=True)]
Finite = Annotated[tuple[float, ...], Bounds(-1e6, 1e6)]
Positives = Annotated[tuple[float, ...], Bounds(0.0, above=True)]
Share = Annotated[float, Bounds(0, 1)]
BelowOne = Annotated[float, Bounds(0, 1, below=True)]
Between = Annotated[float, Bounds(0, 1, above=True, below=True)]  # 0 and 1
Range = Annotated[tuple[float, float], Bounds(0.0, above=True, ascending=True)]


def printable(text: str, longest: int = 500) -> str:
    """A text of a file for one line of a message: at most ``longest`` printable characters."""
    text = text if text.isprintable() else repr(text)
    return text if len(text) <= longest else text[:longest] + "..."


def check(condition: bool, field: str, got: object, expected: str) -> None:
    """Raise a ValueError with the field, the found and the expected value unless a condition holds."""
    if not condition:
        raise ValueError(f"{field}: got {printable(repr(got))}, expected {expected}")


def check_per_class(field: str, values: Collection[object], classes: Collection[str]) -> None:
    """Check that a field has one value per class, or no values, which stand for the usual ones."""
    expected = f"{len(classes)} values, one per class, or no values for the usual ones"
    check(len(values) in (0, len(classes)), field, values, expected)


def check_name(where: str, name: str, known: Iterable[str]) -> None:
    """Raise a ValueError with ``where`` and the nearest known names, or else all of them, for an unknown name."""
    if name not in (known := list(known)):
        expected = " or ".join(difflib.get_close_matches(name, known)) or ", ".join(known)
        raise ValueError(f"{where}: got {name!r}, expected {expected}")


class Checked:
    """Base of frozen dataclasses whose fields must have their annotated type, length and :class:`Bounds`.

    Integers fit floats. Lists and arrays do not fit: compiled programs are looked up by the hash of options.
    """

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self), include_extras=True).items():
            value, bounds = getattr(self, name), None
            if get_origin(kind) is Annotated:
                kind, bounds = get_args(kind)
            check(_fits(kind, value), name, value, _expected(kind))
            check(bounds is None or value is None or bounds.hold(value), name, value, str(bounds))


def _fits(kind: Any, value: Any) -> bool:
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in args)
    if origin is tuple:
        of_length = isinstance(value, tuple) and (args[-1] is Ellipsis or len(value) == len(args))
        return of_length and all(_fits(args[0], entry) for entry in value)
    if args:  # AugmentConfig | None
        return any(_fits(each, value) for each in args)
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, int | float if kind is float else kind)


def _expected(kind: Any) -> str:
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(map(repr, args))
    if origin is tuple:
        number = "" if args[-1] is Ellipsis else f"{len(args)} "
        return f"a tuple of {number}{args[0].__name__}"
    if args:  # AugmentConfig | None
        return " or ".join(map(_expected, args))
    return "None" if kind is type(None) else kind.__name__


def from_json(kind: Any, value: Any, where: str, *, defaults: bool = False) -> Any:
    """Convert a parsed JSON value to a dataclass, a tuple, a ``Literal``, an optional or a plain type.

    ``msgspec.convert`` does not suffice: it ignores unknown fields of dataclasses, fills in missing ones, and its
    messages lack the found value and the choices of a ``Literal``. Integers are accepted as floats; nothing else
    is converted. ``where`` names the value's source in messages; with ``defaults``, fields may be missing.

    Raises:
        ValueError: one line with ``where``, the field, the found and the expected value.

    >>> from_json(tuple[float, ...], [1, 2.5], "a.json")
    (1.0, 2.5)
    >>> from_json(tuple[float, ...], [1, True], "a.json")
    Traceback (most recent call last):
    ValueError: a.json[1]: got True, expected float
    """
    if dataclasses.is_dataclass(kind):
        return _dataclass_from_json(kind, value, where, defaults)
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return value  # Checked by the dataclass, like the length of a tuple.
    if origin is tuple:
        check(isinstance(value, list | tuple), where, value, "a list")
        return tuple(from_json(args[0], entry, f"{where}[{i}]") for i, entry in enumerate(value))
    if args:  # AugmentConfig | None
        return None if value is None else from_json(args[0], value, where)
    too_large = isinstance(value, int) and abs(value) > 1e300  # for a float
    check(_fits(kind, value) and not too_large, where, value, kind.__name__)
    return kind(value)


def _dataclass_from_json(kind: Any, value: Any, where: str, defaults: bool) -> Any:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: got {type(value).__name__}, expected a JSON object")
    hints = get_type_hints(kind)
    for name in value:
        if name not in hints:
            raise ValueError(f"{_place(where, name)}: unknown field, expected one of {', '.join(hints)}")
    for field in dataclasses.fields(kind):
        if field.name not in value and not (defaults and field.default is not dataclasses.MISSING):
            raise ValueError(f"{_place(where, field.name)}: missing")
    fields = {name: from_json(hints[name], entry, _place(where, name)) for name, entry in value.items()}
    try:
        return kind(**fields)
    except ValueError as error:
        raise ValueError(_place(where, str(error))) from None


def _place(where: str, field: str) -> str:
    """``FILE: FIELD``, and ``FILE: FIELD.FIELD`` within a field."""
    return f"{where}{'.' if ': ' in where else ': '}{field}"
