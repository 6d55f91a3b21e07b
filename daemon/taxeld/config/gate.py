"""One gate for what comes from outside: a map of values becomes a frozen dataclass, or lines of
faults.

A field's annotation is its type; `key` gives its default, bounds and meaning. Unknown keys are
refused, and each fault is named by its path (`source.chanel: unknown key`).
"""

import difflib
import re
import reprlib
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache
from types import UnionType
from typing import Any, Generic, TypeVar, cast, get_args, get_origin, get_type_hints

from taxeld.errors import SetupError, one_line

T = TypeVar("T")

LARGEST = 1 << 63  # limit of TOML's own integers, and of all numbers here
KEY_SHOWN = 60  # characters of a key in a message
# tomllib needs time and memory by the square of a key's parts; no key here has more than four
KEY_PARTS = 8
PART = r"""(?:[\w-]+|"(?:\\.|[^"\\\n])*"|'[^'\n]*')"""
LONG_KEY = re.compile(rf"(?<![\w\\-]){PART}(?:[ \t]*\.[ \t]*{PART}){{{KEY_PARTS}}}")
WORDS = {str: "a line of text", int: "an integer", float: "a number", bool: "true or false"}


class ConfigError(SetupError):
    """All faults of a configuration, one line each."""

    def __init__(self, faults: list[str]) -> None:
        self.faults = [one_line(fault) for fault in faults]
        Exception.__init__(self, "\n".join(self.faults))


Bound = Callable[[Any], str | None]  # the fault of a value, None where it has none


@dataclass(frozen=True)
class Given(Generic[T]):
    """The keys of a table T that a file gives, checked; the reader fills in the others."""

    keys: dict[str, Any] = field(default_factory=dict)

    def over(self, base: T) -> T:
        """The table `base` with these keys in place of its own."""
        return cast(T, replace(cast(Any, base), **self.keys))


def between(low: float, high: float, unit: str = "") -> Bound:
    """`unit`: of a key whose name does not end in it."""
    span = f"{low:g}..{high:g} {unit}".rstrip()
    return lambda v: None if low <= v <= high else f"must be {span}, not {v:g}"


def one_of(*values: str | int) -> Bound:
    named = ", ".join(map(str, values))
    return lambda v: None if v in values else f"must be one of {named}, not {v!r}"


def key(default: Any = MISSING, check: Bound | None = None, doc: str = "") -> Any:
    return field(default=default, metadata={"check": check, "doc": doc})


def unwritten(default: Any) -> Any:
    """A field that no file gives."""
    return field(default=default, metadata={"unwritten": True})


def keys_of(cls: type) -> list[Any]:
    """The fields of a table that a file may give."""
    return [each for each in fields(cls) if "unwritten" not in each.metadata]


def loads(text: str, name: str) -> dict[str, Any]:
    """The values of TOML text; `name` is the file's, for messages. Raises ConfigError."""
    if long := LONG_KEY.search(text):
        raise ConfigError([f"{name}: a key of more than {KEY_PARTS} parts: {long[0][:KEY_SHOWN]}"])
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        why = "nested too deep" if isinstance(error, RecursionError) else error
        raise ConfigError([f"{name}: not TOML: {why}"]) from None


def parse(cls: type[T], text: str, name: str) -> T:
    """The dataclass `cls` from TOML text; `name` is the file's, for messages.

    Raises:
        ConfigError: all faults at once.
    """
    faults: list[str] = []
    made = take(cls, loads(text, name), faults)
    if faults:
        raise ConfigError(faults)
    return cast(T, made)


def take(
    cls: type[T], values: Mapping[str, Any], faults: list[str], path: str = "", more: bool = False
) -> T | None:
    """The dataclass `cls` of values; None where it adds to `faults`. `path` leads to them, and
    `more`: they may hold keys that nothing here reads."""
    before = len(faults)
    made = _given(cls, values, faults, path, more)
    needed = [each.name for each in keys_of(cls) if each.default is each.default_factory is MISSING]
    faults += [f"{path}{name}: is required" for name in needed if name not in values]
    return cls(**made) if len(faults) == before else None


def _given(
    cls: type, values: Mapping[str, Any], faults: list[str], path: str, more: bool
) -> dict[str, Any]:
    """The checked values of a dataclass, without defaults."""
    known = {each.name: each for each in keys_of(cls)}
    for name in values.keys() - known if not more else ():
        shown = one_line(str(name)[:KEY_SHOWN])
        near = difflib.get_close_matches(shown, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
        faults.append(f"{path}{shown}: unknown key; {hint}")
    found = {}
    for name, each in known.items():
        if name not in values:
            continue
        own: list[str] = []
        found[name] = taken = value(_hints(cls)[name], values[name], own, path + name, more)
        check = each.metadata.get("check")
        fault = check(taken) if check and not own and taken not in (None, each.default) else None
        if fault:
            own.append(f"{path}{name}: {fault}")
        faults += own
    return found


def value(kind: Any, given: Any, faults: list[str], path: str, more: bool = False) -> Any:
    """A value as its type; None where it adds to `faults`, and where it is None."""
    inner = get_args(kind)
    if get_origin(kind) is UnionType:  # T | None
        return None if given is None else value(inner[0], given, faults, path, more)
    match given:
        case dict() if get_origin(kind) is Given:
            return Given(_given(inner[0], given, faults, f"{path}.", more))
        case dict() if get_origin(kind) is dict:
            return {k: value(inner[1], v, faults, f"{path}.{k}", more) for k, v in given.items()}
        case dict() if is_dataclass(kind):
            return take(cast(type, kind), given, faults, f"{path}.", more)
        case list() | tuple() if inner and (inner[-1] is ... or len(inner) == len(given)):
            items = enumerate(given)
            return tuple(value(inner[0], one, faults, f"{path}[{i}]", more) for i, one in items)
        case bool():
            fits = kind is bool
        case int() | float() if kind is float and abs(given) < LARGEST:
            return float(given)
        case int():
            fits = kind is int and abs(given) < LARGEST
        case str():
            fits = kind is str and given.isprintable()
        case _:
            fits = False
    if not fits:
        faults.append(one_line(f"{path}: must be {_described(kind, path)}, not {_shown(given)}"))
    return given if fits else None


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _described(kind: Any, path: str) -> str:
    if get_origin(kind) is tuple:
        of = get_args(kind)
        if is_dataclass(of[0]):
            return f"a list of tables ([[{path}]] in TOML)"
        return "a list" if of[-1] is ... else f"a list of {len(of)}"
    return WORDS.get(kind, "a table")


def _shown(value: Any) -> str:
    try:
        return reprlib.repr(value)
    except ValueError:  # Python writes no integer of thousands of digits
        return "so large an integer"
