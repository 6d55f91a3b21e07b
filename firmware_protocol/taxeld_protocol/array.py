"""Arrays of any skin: a message of values → a checked frame → a scan (docs/array.md).

A message is one map, `{t, id, z | counts, valid?}`. The module knows no socket, and numbers go in
and out as whole lists, so that a thousand values take a fraction of a millisecond.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from operator import itemgetter
from typing import Any, NamedTuple

from taxeld_protocol.decoder import Scan
from taxeld_protocol.modules import Module

VALUES_MAX = 5000  # values of an array; the largest layout has as many taxels
ID_MAX = 60  # characters of an id
INT_MAX = 1 << 63
T_MAX = 1 << 33  # Unix seconds: later times are of another unit
FULL = 20_000  # counts over rest of an activation of 1: skin.full_scale_counts by default
REST = 1000  # counts of an activation of 0, so that noise may go below it
COUNT_MAX = 65_535
Z_LIMITS = (-0.04, 2.0)  # beyond these no value is an activation
NAMES = 16  # taxels of a module: those of one SUI
BACK_MAX = 10  # ordered frames in a row before the last time: the sender's clock was set back
FUTURE_S = 0.1  # a frame stamped farther in the future tells nothing of the order


class ArrayFrame(NamedTuple):
    """A message that was found good."""

    t: float  # Unix time of the measurement [s]
    id: str
    rest: int  # counts at rest, where the sender gives activations; 0: the skin learns them
    counts: tuple[int, ...]  # in the order of the layout; 0 for no reading


def parse(message: object) -> ArrayFrame | str:
    """The frame of a message, or the reason why it is none, with the cure."""
    if not isinstance(message, dict):
        return "it is no map {t, id, z or counts}"
    t: Any = message.get("t")
    name = message.get("id")
    if not _is_number(t) or not 0.0 <= t < T_MAX:
        return "t is no Unix time in seconds"
    if type(name) is int and abs(name) < INT_MAX:
        name = str(name)
    if not isinstance(name, str) or not name.isprintable() or len(name) > ID_MAX:
        return f"id is no number and no text of at most {ID_MAX} characters"
    given = [key for key in ("z", "counts") if key in message]
    if len(given) != 1:
        return "it must have z (activations 0 to 1) or counts, one of the two"
    key, values, valid = given[0], message[given[0]], message.get("valid")
    if not isinstance(values, list) or not 0 < len(values) <= VALUES_MAX:
        return f"{key} is no list of 1 to {VALUES_MAX} values"
    if valid is not None:
        if not isinstance(valid, list) or len(valid) != len(values):
            return f"valid is no list of as many booleans as {key} has values"
        if not set(map(type, valid)) <= {bool}:
            return "valid has values that are no booleans"
        values = [v if ok else None for v, ok in zip(values, valid, strict=True)]
    low, high = Z_LIMITS if key == "z" else (0, COUNT_MAX)
    fault = _fault(values, low, high)
    if fault:
        return f"{key} {fault}"
    rest, scale = (REST, float(FULL)) if key == "z" else (0, 1.0)
    add = (
        rest + 0.5
    )  # none is negative, so `int` rounds to the nearest, in half the time of `round`
    try:
        counts = [int(v * scale + add) for v in values]
    except TypeError:
        counts = [0 if v is None else int(v * scale + add) for v in values]
    return ArrayFrame(float(t), name, rest, tuple(counts))


def _fault(values: list[Any], low: float, high: float) -> str:
    """Why values are none, None standing for no reading; empty where they are."""
    kinds = set(map(type, values))
    if not kinds <= {int, float, type(None)}:
        return "has values that are no numbers"
    read = [v for v in values if v is not None] if type(None) in kinds else values
    if not read:
        return ""
    # one that is not a number may hide from the limits, but not from the sum
    if not (low <= min(read) and max(read) <= high):
        return f"has values that are not from {low:g} to {high:g}, or not finite"
    return "" if math.isfinite(sum(read)) else "has values that are not finite: mark them invalid"


def _is_number(value: Any) -> bool:
    return type(value) is float or (type(value) is int and abs(value) < INT_MAX)


def read_json(body: bytes | str) -> object:
    """The value of a JSON text; None for anything else, however deep or long its numbers."""
    try:
        return json.loads(body)
    except (ValueError, RecursionError):
        return None


def line_of(frame: ArrayFrame) -> str:
    """A frame as the line of a recording: a message in JSON, with null for no reading."""
    t, name, rest, counts = frame
    key, scale = ("z", FULL) if rest else ("counts", 1)
    values = [(c - rest) / scale if rest else c for c in counts]
    read = [v if c else None for v, c in zip(values, counts, strict=True)]
    return json.dumps({"t": t, "id": name, key: read}, separators=(",", ":"))


@dataclass(frozen=True, slots=True)
class Group(Module):
    """Taxels of one SUI, without a temperature; their names may be any of a UID's."""

    @property
    def names(self) -> list[int]:
        return [bit for bit in range(NAMES) if self.mask >> bit & 1]


@dataclass(slots=True)
class ArrayCounters:
    """Frames, since start."""

    scans: int = 0
    incomplete: int = 0  # scans with values without a reading
    length_errors: int = 0  # frames of another number of values
    foreign: int = 0  # frames of another id
    disordered: int = 0  # frames not later than one before: of a second sender, or late
    mixed: int = 0  # frames with counts of an array that gives activations, or the other way


class ArrayDecoder:
    """Frames of one array → scans."""

    def __init__(self, uids: Sequence[int], name: str = "") -> None:
        """`uids`: of the layout, in its order; `name`: the array's id, empty for the first that
        comes."""
        self.counters = ArrayCounters()
        self.fault = ""  # a line on the last frame that was not used; empty where it was
        self.now_t = math.inf  # Unix time up to which a frame may set the order, where it is known
        masks: dict[int, int] = {}
        for uid in uids:
            masks[uid >> 4] = masks.get(uid >> 4, 0) | 1 << (uid & 0xF)
        groups = [Group(mask.bit_count(), sui, mask) for sui, mask in sorted(masks.items())]
        self.table = tuple(groups)
        order = sorted(range(len(uids)), key=uids.__getitem__)
        is_sorted = order == list(range(len(uids)))
        self._sorted: Callable[[tuple[int, ...]], tuple[int, ...]] = (
            tuple if is_sorted else itemgetter(*order)
        )
        self._size, self._name, self._frames = len(uids), name, 0
        self._rest: int | None = None
        self._t = self._back_t = -math.inf  # of the last frame, and of the last that went back
        self._back = 0  # frames in a row that went back, in order among themselves

    def take(self, frames: Iterable[ArrayFrame]) -> Iterator[tuple[None, list[Scan]]]:
        """As `feed`, one after the other."""
        return map(self.feed, frames)

    def feed(self, frame: ArrayFrame) -> tuple[None, list[Scan]]:
        """The scan of a frame; none where it cannot be used."""
        self._frames += 1
        self.fault = self._judge(frame)
        if self.fault:
            return None, []
        self.counters.scans += 1
        self.counters.incomplete += 0 in frame.counts
        counts = self._sorted(frame.counts)
        return None, [Scan(frame.t, 0, counts, self.table, 0, frame.rest)]

    def stats(self) -> dict[str, int | dict[str, int]]:
        """All counters; `frames` = `used` + the sum of `dropped`."""
        known = asdict(self.counters)
        dropped = {k: known.pop(k) for k in ("length_errors", "foreign", "disordered", "mixed")}
        no_line = dict.fromkeys(("bytes", "bytes_used", "bytes_dropped"), 0)
        used = known["scans"]
        return {"frames": self._frames, "used": used, "dropped": dropped, **known, **no_line}

    def _judge(self, frame: ArrayFrame) -> str:
        """Why a frame is not used; empty where it is."""
        counters = self.counters
        self._name = self._name or frame.id
        if frame.id != self._name:
            counters.foreign += 1
            return f"source.array: arrays of id {frame.id} come, and {self._name} is heard"
        if len(frame.counts) != self._size:
            counters.length_errors += 1
            return f"skin.layout: has {self._size} taxels, and arrays have {len(frame.counts)}"
        if self._rest is None:
            self._rest = frame.rest
        if frame.rest != self._rest:
            counters.mixed += 1
            return f"source.array: {self._name} sends both z and counts; send one of the two"
        if frame.t > self.now_t + FUTURE_S:  # it would keep out all others; the pipeline refuses it
            return ""
        if frame.t <= self._t and not self._is_set_back(frame.t):
            counters.disordered += 1
            return f"source.array: times of {self._name} go back; do two programs send it?"
        self._t, self._back = frame.t, 0
        return ""

    def _is_set_back(self, t: float) -> bool:
        """Whether enough frames from the past came in a row that they are the present."""
        self._back = self._back + 1 if t > self._back_t else 1
        self._back_t = t
        return self._back >= BACK_MAX
