"""Frames of binary logs: Vector's blf, and python-can's SQLite files.

python-can reads both as well, but a blf with an object of no length keeps it busy for ever, and one
that unpacks to more than there is memory takes it.
"""

import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from taxeld.source.logs.text import BLOCK, EXTENDED_MAX, STANDARD_MAX, Damage
from taxeld_protocol.frames import Frame, Logged

BLF, SQLITE = b"LOGG", b"SQLite format 3\0"  # that the files begin with

_FILE = struct.Struct("<40x8H")  # start: year, month, day of the week, day, hour, minute, s, ms
_OBJECT = struct.Struct("<4sHHLL")  # signature, header's size and version, size, type
_CONTAINER = struct.Struct("<H14x")  # compression
_STAMP = {1: struct.Struct("<L4xQ"), 2: struct.Struct("<L4xQ8x")}  # by version: unit, time
_MESSAGE = struct.Struct("<HBBL8s")  # channel, flags, length, id, data
_SIGNATURE = b"LOBJ"
_CONTAINER_TYPE = 10
_MESSAGE_TYPES = {1, 86}
_OTHER_TYPES = {2, 73, 100, 101, 104}  # error frames, and those of FD
_REMOTE, _EXTENDED = 0x80, 0x8000_0000
_TEN_US = 1  # the unit, else nanoseconds
_PLAIN, _ZLIB = 0, 2
_GAP = 8  # bytes between two objects at most
LARGEST = 1 << 24  # bytes of an object; a container usually has 128 KiB
TIME_MAX_S = 1e12


class BlfReader:
    """One pass through a blf file: containers, mostly compressed, of objects that may run over."""

    def __init__(self, damage: Damage) -> None:
        self._damage = damage
        self._start_s = 0.0
        self._buffer = bytearray()  # objects, the last of which may go on in the next container

    def read(self, file: BinaryIO) -> Iterator[list[Logged]]:
        """The frames in the order of the file, a container's at a time."""
        head = file.read(_FILE.size)
        if len(head) < _FILE.size:
            self._damage.at("byte 0", "a header that is cut")
            return
        self._start_s = _unix(*_FILE.unpack(head))
        at = _next_object(file, _FILE.size)
        while True:
            file.seek(at)
            header = file.read(_OBJECT.size)
            if len(header) < _OBJECT.size:
                break
            signature, _, _, size, kind = _OBJECT.unpack(header)
            whole = signature == _SIGNATURE and _OBJECT.size <= size <= LARGEST
            content = file.read(size - _OBJECT.size) if whole else b""
            try:
                if not whole or len(content) < size - _OBJECT.size:
                    raise ValueError("no object of a blf file, or one that is cut")
                if kind == _CONTAINER_TYPE:
                    self._buffer += _unpacked(content)
                    yield self._objects(f"byte {at}")
                at += size + size % 4
            except (ValueError, zlib.error) as error:
                self._damage.at(f"byte {at}", str(error))
                self._buffer.clear()
                at = _next_object(file, at + 1)  # its size may be damaged as well
        if len(header) + len(self._buffer) >= _GAP:
            self._damage.at(f"byte {at}", "the end of an object is missing")

    def _objects(self, where: str) -> list[Logged]:
        """The frames among the whole objects of the buffer, which are taken out."""
        buffer, logged = self._buffer, list[Logged]()
        at = 0
        while True:
            found = buffer.find(_SIGNATURE, at, at + _GAP)
            if found < 0 and len(buffer) - at < _GAP:
                break
            if found < 0:
                self._damage.at(where, "what is no object")
                found = buffer.find(_SIGNATURE, at)
                at = len(buffer) if found < 0 else found
                continue
            at = found
            if len(buffer) - at < _OBJECT.size:
                break
            _, header, version, size, kind = _OBJECT.unpack_from(buffer, at)
            if not _OBJECT.size <= header <= size <= LARGEST:
                self._damage.at(where, "an object of no possible size")
                at += len(_SIGNATURE)
                continue
            if len(buffer) - at < size:
                break
            if kind in _MESSAGE_TYPES and version in _STAMP:
                logged += self._message(where, bytes(buffer[at : at + size]), _STAMP[version])
            elif kind in _OTHER_TYPES:
                logged.append(("", None))
            at += size
        del buffer[:at]
        return logged

    def _message(self, where: str, data: bytes, stamp: struct.Struct) -> list[Logged]:
        begin = _OBJECT.size + stamp.size
        if len(data) >= begin + _MESSAGE.size:
            unit, ticks = stamp.unpack_from(data, _OBJECT.size)
            channel, flags, length, number, content = _MESSAGE.unpack_from(data, begin)
            extended, number = bool(number & _EXTENDED), number & ~_EXTENDED
            if flags & _REMOTE:
                return [(str(channel), None)]
            if length <= 15 and number <= (EXTENDED_MAX if extended else STANDARD_MAX):
                t = self._start_s + ticks * (1e-5 if unit == _TEN_US else 1e-9)
                return [(str(channel), Frame(t, number, content[:length], extended))]
        self._damage.at(where, "a frame of no possible length or id")
        return []


def _unpacked(container: bytes) -> bytes:
    """The objects in a container. Raises ValueError or zlib.error."""
    packing = _CONTAINER.unpack_from(container)[0] if len(container) >= _CONTAINER.size else None
    data = container[_CONTAINER.size :]
    if packing == _ZLIB:
        unpacking = zlib.decompressobj()
        data = unpacking.decompress(data, LARGEST)
        if unpacking.unconsumed_tail:
            raise ValueError("a container of more than 16 MiB")
    elif packing != _PLAIN:
        raise ValueError("a container that is cut, or packed in another way")
    return data


def _next_object(file: BinaryIO, at: int) -> int:
    """Where the next object of a file begins from `at` on, or the file's end."""
    file.seek(at)
    data = b""
    while read := file.read(BLOCK):
        data = data[-len(_SIGNATURE) :] + read
        found = data.find(_SIGNATURE)
        if found >= 0:
            return file.tell() - len(data) + found
    return file.tell()


def _unix(
    year: int, month: int, _: int, day: int, hour: int, minute: int, second: int, ms: int
) -> float:
    """Unix time of a header's start; 0 where it has none."""
    try:
        return datetime(year, month, day, hour, minute, second, ms * 1000, UTC).timestamp()
    except ValueError:
        return 0.0


def sqlite_frames(path: Path, damage: Damage) -> Iterator[list[Logged]]:
    """The frames of python-can's SQLite file, in the order in which they were written."""
    rows_most = path.stat().st_size  # each takes more than a byte, unless the file runs in circles
    row = 0
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as base:
            base.text_factory = bytes  # which any text is
            tables = base.execute("SELECT type FROM sqlite_master WHERE name = 'messages'")
            if tables.fetchall() != [(b"table",)]:
                raise sqlite3.DatabaseError("there is no table 'messages'")
            rows = base.execute(
                "SELECT ts, arbitration_id, extended, remote OR error, CASE typeof(data) "
                "WHEN 'blob' THEN ifnull(substr(data, 1, 9), x'') WHEN 'null' THEN x'' END "
                "FROM messages ORDER BY rowid"
            )
            while found := rows.fetchmany(1000):
                logged: list[Logged] = []
                for row, values in enumerate(found, row + 1):  # noqa: B020
                    try:
                        logged.append(("", _row(*values)))
                    except ValueError:
                        damage.at(f"row {row}", repr(values))
                yield logged
                if row > rows_most:
                    raise sqlite3.DatabaseError("it runs in circles")
    except sqlite3.Error as error:
        damage.at(f"row {row + 1}", str(error))


def _row(t: object, number: object, extended: object, other: object, data: object) -> Frame | None:
    """A frame; None is one that carries nothing for a skin. Raises ValueError."""
    if other or (isinstance(data, bytes) and len(data) > 8):
        return None
    if not isinstance(number, int) or not isinstance(data, bytes):
        raise ValueError("not the types of a frame")
    if not isinstance(t, int | float) or not abs(t) < TIME_MAX_S:
        raise ValueError("no time")
    if not 0 <= number <= (EXTENDED_MAX if extended else STANDARD_MAX):
        raise ValueError("no id")
    return Frame(float(t), number, data, bool(extended))
