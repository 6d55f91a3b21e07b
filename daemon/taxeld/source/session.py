"""A recorded session: a directory with what the loop took from skin and robot, in its order.

`arrivals` has msgpack records `[t, link, kind, bytes]`; t is the Unix time of the arrival, and the
link that of a pose, or the first on the source:

    head   the first record: a map of the fields of `Head`
    frame  a CAN frame of either direction: 4 bytes of its id (little-endian; bit 31: extended),
           and its data
    line   bytes of a serial line that were read together
    array  a message of an array, in JSON
    pose   of a link's sensor: t, x, y, θ as float64, t by the robot's clock
    pass   the loop worked at t on what had come
    late   of what had come of this source since the last pass, no scan was used
    step   the Unix clock was set forward by so many seconds, a float64

Beside it are `config.toml` and, from the harness, `truth.csv`. A recording may end anywhere: it is
read up to the first record that is not whole.
"""

import contextlib
import logging
import math
import os
import struct
from collections.abc import Generator, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import msgpack
import numpy as np

from taxeld import files
from taxeld.arrays import Poses
from taxeld.config import gate
from taxeld.config.file import load
from taxeld.config.tables import Config, SourceConfig, modules_fault
from taxeld.errors import SetupError
from taxeld_protocol import array
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Chunk, Frame

ARRIVALS, TRUTH, CONFIG = "arrivals", "truth.csv", "config.toml"
VERSION = 3  # the versions before it had a file for each kind
ID, POSE, FLOAT = struct.Struct("<I"), struct.Struct("<4d"), struct.Struct("<d")
EXTENDED = 1 << 31
FRAME_BYTES, LINKS = ID.size + 8, range(256)
LIMITS = {"max_bin_len": 1 << 20, "max_str_len": 8, "max_array_len": 4, "max_map_len": 0}
DAMAGED = ValueError, TypeError, LookupError, struct.error, msgpack.UnpackException
AGAIN = "record it again"

log = logging.getLogger(__name__)


def _lists_fault(lists: dict[int, tuple[tuple[int, ...], ...]]) -> str | None:
    return next(filter(None, map(modules_fault, lists.values())), None)


@dataclass(frozen=True)
class Head:
    """What a session says of itself."""

    version: int
    moves: bool  # whether a robot sends the sensor's pose
    # first link of a source → its `source.modules`
    modules: dict[int, tuple[tuple[int, ...], ...]] = field(metadata={"check": _lists_fault})

    def listed(self, config: SourceConfig, link: int) -> tuple[tuple[int, ...], ...]:
        """The modules of the source whose first link it is: this configuration's, or the list in
        the head."""
        return config.modules or self.modules.get(link, ())


class SensorPose(NamedTuple):
    """A sensor's pose in the world, as the robot sent it."""

    t: float
    x: float
    y: float
    theta: float


class Pass(NamedTuple):
    t: float


class Late(NamedTuple):
    t: float


class ClockStep(NamedTuple):
    t: float
    by: float


Item = Frame | Chunk | ArrayFrame | SensorPose | Pass | Late | ClockStep


class Arrival(NamedTuple):
    t: float
    link: int
    item: Item | Head


def config_of(directory: Path, given: Path | None = None) -> Config:
    """The configuration of a session, or the `given` one in its place.

    Raises:
        SetupError: there is no session, or the configuration has faults.
    """
    if not directory.is_dir() or not (given or (directory / CONFIG).is_file()):
        raise SetupError(
            f"{directory}: is no session (it has no {CONFIG}); 'taxeld record' and "
            "'taxeld run --record' make one"
        )
    return load(given or directory / CONFIG)


def head(directory: Path) -> tuple[float, Head]:
    """Unix time at which a session begins, and what it says of itself.

    Raises:
        SetupError: there is none, or it is of another version.
    """
    with contextlib.closing(_whole(directory)) as whole:
        first = next(whole, None)
    if first is None or not isinstance(first.item, Head) or first.item.version != VERSION:
        what = "is a session of another version of taxeld, or damaged"
        raise SetupError(f"{directory}: {what}; {AGAIN}")
    return first.t, first.item


def arrivals(directory: Path) -> Iterator[Arrival]:
    """What came, in the order in which the loop took it, never held whole. At its end, the log has
    one line on what is missing of a cut session.

    Raises:
        SetupError: there is none, it is of another version, or empty.
    """
    head(directory)
    whole = _whole(directory)
    next(whole)
    return whole


def packed(arrival: Arrival) -> bytes:
    """The record of an arrival."""
    t, link, item = arrival
    match item:
        case Frame():
            kind, data = "frame", ID.pack(item.can_id | EXTENDED * item.extended) + item.data
        case Chunk():
            kind, data = "line", item.data
        case ArrayFrame():
            kind, data = "array", array.line_of(item).encode()
        case SensorPose():
            kind, data = "pose", POSE.pack(*item)
        case ClockStep():
            kind, data = "step", FLOAT.pack(item.by)
        case Head():
            kind, data = "head", msgpack.packb(asdict(item))
        case _:
            kind, data = type(item).__name__.lower(), b""
    return bytes(msgpack.packb((t, link, kind, data)))


def _arrival(t: float, link: int, kind: str, data: bytes) -> Arrival:
    """The arrival of a record. Raises DAMAGED where it is none."""
    if not math.isfinite(t) or link not in LINKS:
        raise ValueError(link)
    return Arrival(t, link, _item(t, kind, data))


def _item(t: float, kind: str, data: bytes) -> Item | Head:
    match kind:
        case "frame" if len(data) <= FRAME_BYTES:
            (number,) = ID.unpack_from(data)
            return Frame(t, number % EXTENDED, data[ID.size :], number >= EXTENDED)
        case "line":
            return Chunk(t, data)
        case "array":
            frame = array.parse(array.read_json(data))
            if isinstance(frame, ArrayFrame):
                return frame
        case "pose":
            return SensorPose(*POSE.unpack(data))
        case "pass":
            return Pass(t)
        case "late":
            return Late(t)
        case "step":
            (by,) = FLOAT.unpack(data)
            if math.isfinite(by):
                return ClockStep(t, by)
        case "head":
            about = dict(msgpack.unpackb(data, strict_map_key=False))
            if made := gate.take(Head, about, []):
                return made
    raise ValueError(kind)


def _whole(directory: Path) -> Generator[Arrival]:
    """The whole records of a session. Raises SetupError where there is no file, or only a head."""
    path, held = directory / ARRIVALS, list[Arrival]()
    count = end = at = 0
    try:
        with files.opened(path) as file:
            size, records = os.fstat(file.fileno()).st_size, msgpack.Unpacker(file, **LIMITS)
            with contextlib.suppress(*DAMAGED):
                # zeros, which a power cut leaves, may have filled a record before what is none
                for record in records:
                    arrival = _arrival(*record)
                    yield from held
                    count, end, held = count + len(held), at, [arrival]
                    at = records.tell()
                yield from held
                count, end = count + len(held), at
    except FileNotFoundError:
        older = "was recorded by an older version of taxeld, or nothing came"
        raise SetupError(f"{directory}: has no {ARRIVALS}: it {older}; {AGAIN}") from None
    except OSError as error:
        raise SetupError(f"{path}: unreadable ({error.strerror})") from None
    if count == 1:
        raise SetupError(f"{directory}: holds nothing that came, it is empty; {AGAIN}")
    if count and end < size:
        what = f"used are {count} records, {end} of its {size} bytes"
        log.warning("%s: the recording was cut; %s", directory, what)


def truth(directory: Path) -> Poses | None:
    """(3,) the object's last true pose; None where the session does not have it.

    Raises:
        SetupError: the table (`t,x,y,theta`) is damaged.
    """
    path = directory / TRUTH
    if not path.exists():
        return None
    try:
        *_, last = files.read(path).decode("ascii").splitlines()
        _, x, y, theta = map(float, last.split(","))
    except (OSError, ValueError) as error:
        raise SetupError(f"{path}: is no table of t,x,y,theta ({error})") from None
    return np.array([x, y, theta])
