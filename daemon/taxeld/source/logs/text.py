"""Frames of a text log, by a format that one regular expression tells.

A block of lines that are all frames goes through it at once; any other block line by line, so that
a damaged line costs itself alone. Memory is that of a block, whatever the log holds.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import Protocol

from taxeld.errors import one_line
from taxeld_protocol.frames import Frame, Logged

BLOCK = 1 << 14  # bytes: what is made of them stays in a processor's cache
ENDLESS = b"?"  # in place of a line that is longer than a block, which is no frame
STANDARD_MAX, EXTENDED_MAX = 0x7FF, 0x1FFF_FFFF
IDS_KEPT = 4096  # more than a bus with standard ids has
COLOUR = re.compile(r"\x1b\[[0-9;]*m")  # of a terminal
MARK = b"\xef\xbb\xbf".decode("latin-1")  # that some editors begin a file with
SHOWN = 60  # characters of what is damaged


@dataclass(slots=True)
class Damage:
    """What of a log is damaged, or no frame: it is left out, counted, and the first named."""

    count: int = 0
    first: str = ""

    def at(self, where: str, what: str) -> None:
        if not self.count:
            self.first = one_line(f"{where}: '{what.strip()[:SHOWN]}'")
        self.count += 1


class Readable(Protocol):
    """What a log is read from."""

    def read(self, size: int, /) -> bytes: ...


@dataclass(frozen=True, slots=True)
class Format:
    """How a log is written. Its functions raise ValueError for what is damaged.

    The patterns are searched for in whole lines, many at a time (`compiled`), and their groups are
    the time, the interface, and of frames also the id and the data.
    """

    frames: re.Pattern[str]
    others: re.Pattern[str]  # frames that carry nothing for a skin
    passed: re.Pattern[str]  # what else may stand in a log; the time alone
    can_id: Callable[[str], tuple[int, bool]]  # the id, and whether it is extended
    data: Callable[[str], bytes]
    seconds: Callable[[str], float] = float
    units_per_s: float = 1.0  # of what `seconds` gives
    start_s: float = 0.0
    differences: bool = False  # a time is that since the line before


def compiled(pattern: str) -> re.Pattern[str]:
    """For `^` and `$` at the ends of lines. A pattern may not use `\\s`, which runs over them."""
    return re.compile(pattern, re.ASCII | re.MULTILINE)


def blocks(file: Readable) -> Iterator[tuple[int, str]]:
    """Whole lines, some at a time and without their last end, with the number of the first."""
    number, rest = 1, b""
    while read := file.read(BLOCK):
        lines, end, rest = (rest + read).rpartition(b"\n")
        if end:
            yield number, _plain(lines)
            number += lines.count(b"\n") + 1
        if len(rest) > BLOCK:
            rest = ENDLESS
    if rest:
        yield number, _plain(rest)


def _plain(lines: bytes) -> str:
    text = lines.decode("latin-1")
    return COLOUR.sub("", text) if "\x1b" in text else text.removeprefix(MARK)


def interfaces(file: Readable, form: Format) -> set[str]:
    """Whose frames stand in a log; "" are those of no named one."""
    found: set[str] = set()
    only = ""
    for _, text in blocks(file):
        if only and text.count(only) == text.count("\n") + 1:
            continue  # the same in each line, as in most logs, and quickly found
        here = set(map(itemgetter(1), form.frames.findall(text)))
        found |= here
        name = here.pop() if len(here) == 1 else ""
        only = "" if not name or name.isdigit() else f" {name} "  # other numbers may stand there
    return found


class TextReader:
    """One pass through a log."""

    def __init__(self, form: Format, damage: Damage) -> None:
        self._form = form
        self._damage = damage
        self._ids = _Ids(form.can_id)
        self._elapsed = 0.0  # the sum of the differences

    def read(self, file: Readable) -> Iterator[list[Logged]]:
        """The frames in the order of the file, some at a time."""
        for number, text in blocks(file):
            found = self._form.frames.findall(text)
            logged = None
            if len(found) == text.count("\n") + 1:
                logged = self._whole(found)
            yield self._by_line(number, text) if logged is None else logged

    def _by_line(self, number: int, text: str) -> list[Logged]:
        logged: list[Logged] = []
        for place, line in enumerate(text.split("\n"), number):
            found = self._form.frames.findall(line)
            frames = self._whole(found) if found else None
            if frames is None:
                frames = self._other(line)
            if frames is None:
                self._damage.at(f"line {place}", line)
            else:
                logged += frames
        return logged

    def _whole(self, found: list[tuple[str, str, str, str]]) -> list[Logged] | None:
        """The frames of matches; None where one of them only looks like a frame."""
        form, ids, elapsed = self._form, self._ids, self._elapsed
        seconds, data, add = form.seconds, form.data, form.differences
        start_s, units_per_s = form.start_s, form.units_per_s
        logged: list[Logged] = []
        try:
            for stamp, interface, can_id, payload in found:
                t = seconds(stamp) if stamp else 0.0
                if add:
                    t = elapsed = elapsed + t
                number, extended = ids[can_id]
                frame = Frame(start_s + t / units_per_s, number, data(payload), extended)
                logged.append((interface, frame))
        except ValueError:
            return None
        self._elapsed = elapsed
        return logged

    def _other(self, line: str) -> list[Logged] | None:
        """A line without a frame for a skin; None where it is damaged."""
        other = self._form.others.match(line)
        passed = other or self._form.passed.match(line)
        if passed is None:
            return None
        if self._form.differences and passed[1]:
            try:
                self._elapsed += self._form.seconds(passed[1])
            except ValueError:
                return None
        return [(other[2] or "", None)] if other else []


class _Ids(dict[str, tuple[int, bool]]):
    """Ids as a log has them → (id, whether it is extended), of a log that repeats them."""

    def __init__(self, parse: Callable[[str], tuple[int, bool]]) -> None:
        super().__init__()
        self._parse = parse

    def __missing__(self, text: str) -> tuple[int, bool]:
        """Raises ValueError where it is no id."""
        number, extended = self._parse(text)
        if number > (EXTENDED_MAX if extended else STANDARD_MAX):
            raise ValueError(f"{text} is no id")
        if len(self) >= IDS_KEPT:
            self.clear()
        self[text] = number, extended
        return number, extended
