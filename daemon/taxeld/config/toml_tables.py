"""TOML files as frozen dataclasses: types, defaults, bounds, and all faults in one pass.

Unknown keys are refused, and every fault is named by its path (`source.chanel: unknown key`).
"""

import difflib
import math
import re
import reprlib
import tomllib
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from typing import Any, Generic, TypeVar, cast, get_args, get_origin, get_type_hints

from taxeld.config import gone
from taxeld.errors import SetupError, one_line

T = TypeVar("T")

INTEGER_MAX = 1 << 63  # limit of TOML's own integers
PARTS = 8  # of a key: tomllib takes time by the square of their number
KEY_SHOWN = 60  # characters of a key in a message


class ConfigError(SetupError):
    """All faults of a configuration, one line each."""

    def __init__(self, faults: list[str]) -> None:
        self.faults = [one_line(fault) for fault in faults]
        Exception.__init__(self, "\n".join(self.faults))


Bound = Callable[[Any], str | None]


@dataclass(frozen=True)
class Given(Generic[T]):
    """The keys of a table T that a file gives, checked; the reader fills in the others."""

    keys: dict[str, Any] = field(default_factory=dict)

    def over(self, base: T) -> T:
        """The table `base` with these keys in place of its own."""
        return cast(T, replace(cast(Any, base), **self.keys))


def between(low: float, high: float) -> Bound:
    return lambda v: None if low <= v <= high else f"must be {low:g}..{high:g}, not {v:g}"


def one_of(*values: str | int) -> Bound:
    named = ", ".join(map(str, values))
    return lambda v: None if v in values else f"must be one of {named}, not {v!r}"


def key(default: Any = MISSING, check: Bound | None = None, doc: str = "") -> Any:
    return field(default=default, metadata={"check": check, "doc": doc})


def unwritten(default: Any) -> Any:
    """A field that no file sets."""
    return field(default=default, metadata={"tables": None})


def loads(text: str) -> dict[str, Any]:
    """The values of TOML text. Raises ValueError with the fault."""
    for number, line in enumerate(text.splitlines(), 1):
        head, equals, _ = line.partition("=")
        if (equals or line.startswith("[")) and head.count(".") > PARTS and "," not in head:
            raise ValueError(f"line {number}: a key of more than {PARTS} parts")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not TOML: {error}") from None
    except RecursionError:
        raise ValueError("not TOML: nested too deep") from None
    except ValueError:
        raise ValueError("not TOML: a number has thousands of digits") from None


class _Short(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = 80

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if abs(x) < INTEGER_MAX else "so large an integer"


def parse(cls: type[T], text: str, name: str) -> T:
    """The dataclass `cls` from TOML text; `name` is the file's, for messages.

    Raises:
        ConfigError: all faults at once.
    """
    try:
        data = loads(text)
    except ValueError as error:
        raise ConfigError([f"{name}: {error}"]) from None
    faults: list[str] = []
    parsed = _table(cls, data, "", faults)
    if faults:
        raise ConfigError(faults)
    return cast(T, parsed)


def _table(cls: type, data: dict[str, Any], path: str, faults: list[str]) -> object:
    """A dataclass from a TOML table; None where its faults make that impossible."""
    before = len(faults)
    data = getattr(cls, "filled", lambda given: given)(data)
    values = _values(cls, data, path, faults)
    for name, spec in ((f.name, f) for f in fields(cls) if f.name not in data):
        if spec.default is MISSING and spec.default_factory is MISSING:
            faults.append(f"{path}{name}: is required")
    return cls(**values) if len(faults) == before else None


def _values(cls: type, data: dict[str, Any], path: str, faults: list[str]) -> dict[str, Any]:
    """The keys that a TOML table gives of a dataclass."""
    known = {f.name: f for f in fields(cls) if "tables" not in f.metadata}
    for spec in fields(cls):  # a table that may also be given as several, [[table]]
        name = spec.metadata.get("tables")
        if name and isinstance(data.get(name), list):
            known[name] = spec
    hints = get_type_hints(cls)
    for name in data.keys() - known:
        if line := _gone(path + name):
            faults.append(line)
            continue
        near = difflib.get_close_matches(name[:KEY_SHOWN], known, 1)
        hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
        faults.append(f"{path}{name[:KEY_SHOWN]}: unknown key; {hint}")
    return {
        spec.name: _value(hints[spec.name], spec, data[name], path + name, faults)
        for name, spec in known.items()
        if name in data
    }


def _value(kind: Any, spec: Field[Any], value: Any, path: str, faults: list[str]) -> Any:
    inner = get_args(kind)[0] if get_origin(kind) is tuple else kind
    if inner is not kind and hasattr(inner, "__dataclass_fields__"):
        if isinstance(value, list) and all(isinstance(item, dict) for item in value):
            items = enumerate(value)
            return tuple(_table(inner, item, f"{path}[{i}].", faults) for i, item in items)
        faults.append(f"{path}: must be tables [[{path}]]")
        return None
    given = get_origin(kind) is Given
    if given or hasattr(kind, "__dataclass_fields__"):
        if isinstance(value, dict) and given:
            return Given(_values(get_args(kind)[0], value, path + ".", faults))
        if isinstance(value, dict):
            return _table(kind, value, path + ".", faults)
        faults.append(f"{path}: must be a table [{path}]")
        return None
    converted = _convert(kind, value)
    if converted is None:
        faults.append(f"{path}: must be {_describe(kind)}, not {_Short().repr(value)}")
        return None
    check = spec.metadata["check"]
    fault = check(converted) if check and converted != spec.default else None
    if fault:
        faults.append(_gone(f'{path} = "{converted}"') or f"{path}: {fault}")
    return converted


def _gone(what: str) -> str | None:
    """The line about a key or value that is gone, whichever of several tables it stands in."""
    return gone.why(re.sub(r"^skin\[\d+\]\.(?=source)|\[\d+\]", "", what))


def _convert(kind: Any, value: Any) -> Any:
    """The TOML value as `kind`; None if it is of another type, because TOML has no null."""
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        if not isinstance(value, list) or (inner[-1] is not Ellipsis and len(value) != len(inner)):
            return None
        items = tuple(_convert(inner[0], item) for item in value)
        return None if None in items else items
    if isinstance(value, int) and abs(value) >= INTEGER_MAX:
        return None
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is float and isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if type(value) is kind else None


def _describe(kind: Any) -> str:
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        size = "" if inner[-1] is Ellipsis else f" of {len(inner)}"
        of = _describe(inner[0]) if get_origin(inner[0]) is tuple else inner[0].__name__
        return f"a list{size} ({of})"
    return {str: "a string", int: "an integer", float: "a number", bool: "true or false"}[kind]
