"""Recorded traffic as a file: what kind of log it is, told by its content, and what it holds.

A log is read from its beginning as often as is asked for, and never held in memory.
"""

import gzip
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from operator import itemgetter
from pathlib import Path
from typing import Self

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.logs import binary, formats, serial
from taxeld.source.logs.text import BLOCK, Damage, Format, Readable, TextReader, interfaces
from taxeld.source.session import Chunk
from taxeld.source.wire import Heard, Wire
from taxeld_protocol.decoder import ScanDecoder
from taxeld_protocol.frames import Logged

GZIP = b"\x1f\x8b\x08"
BINARY = {binary.BLF: "blf", binary.SQLITE: "sqlite"}
NOT_READ = {  # what other files begin with, and the cure
    b"MDF     ": "is an MF4 measurement; convert it first, as with python -m can.logconvert",
    b"UnFinMF ": "is an MF4 measurement; convert it first, as with python -m can.logconvert",
    b"\xfd7zXZ\0": "is packed with xz; unpack it first",
    b"BZh": "is packed with bzip2; unpack it first",
    b"PK\x03\x04": "is packed with zip; unpack it first",
    b"\x28\xb5\x2f\xfd": "is packed with zstd; unpack it first",
}
KNOWN = "logs of candump, asc, trc, csv, blf and SQLite are read, and the serial.bin of a session"
NAMED_MOST = 10  # interfaces, in a message


class LogFile:
    """A log of frames or of a serial line, packed with gzip or not."""

    def __init__(self, path: Path) -> None:
        """Raises SetupError where it is unreadable, or no log."""
        self.path = path
        self._kept = ExitStack()  # files that go with this
        self._format: Format | None = None  # of a text log
        with ExitStack() as undone, self._readable():
            undone.push(self._kept)
            self._file = self._in_place()
            with self._file.open("rb") as file:
                self._is_packed = file.read(len(GZIP)) == GZIP
            self._kind = self._told()
            undone.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.close()

    def check(self, interface: str) -> None:
        """Whether it is clear whose frames are meant, before any is decoded.

        Raises:
            SetupError: the log has none at all, or none of that interface; or those of several, and
                none is named.
        """
        if self.framing:
            found = {""}
        else:
            damage = Damage()
            with self._readable():
                found = self._interfaces(damage)
            if not found:
                raise SetupError(f"{self.path}: has no frame; {damage.first or KNOWN}")
        names = ", ".join(sorted(found - {""})[:NAMED_MOST])
        if interface and interface not in found:
            cure = f"it has those of {names}" if names else "it names no interface; leave this out"
            raise SetupError(f"--interface: {self.path} has no frame of {interface}; {cure}")
        if not interface and len(found - {""}) > 1:
            raise SetupError(
                f"{self.path}: has frames of several interfaces, {names}; name the skin's with "
                "--interface"
            )

    @property
    def framing(self) -> str:
        """Of the bytes of a serial line, "" of a log of frames."""
        return self._kind if self._kind in serial.FRAMINGS else ""

    def frames(self, damage: Damage) -> Iterator[list[Logged]]:
        """The frames of a bus, some at a time. Raises SetupError where it is unreadable."""
        with self._readable():
            if self._kind == "sqlite":
                yield from binary.sqlite_frames(self._file, damage)
            elif self._kind == "blf":
                with self._file.open("rb") as file:
                    yield from binary.BlfReader(damage).read(file)
            elif self._format is not None:
                with self._open(damage) as file:
                    yield from TextReader(self._format, damage).read(file)

    def chunks(self, damage: Damage) -> Iterator[Chunk]:
        """The bytes of a serial line. Raises SetupError where they are unreadable."""
        with self._readable(), self._open(damage) as file:
            yield from serial.chunks(file, serial.times(self.path), damage)

    def _interfaces(self, damage: Damage) -> set[str]:
        """Whose frames the log has, "" for those of no named one."""
        if self._format is not None:
            with self._open(damage) as file:
                return interfaces(file, self._format)
        return {name for batch in self.frames(damage) for name in map(itemgetter(0), batch)}

    def _told(self) -> str:
        """The kind of log."""
        with self._open() as file:
            head = file.read(BLOCK)
        for begin, cure in NOT_READ.items():
            if head.startswith(begin):
                raise SetupError(f"{self.path}: {cure}")
        for begin, kind in BINARY.items():
            if head.startswith(begin):
                if self._is_packed:  # these are read here and there
                    with self._open() as file:
                        self._file, self._is_packed = self._copied(file), False
                return kind
        with self._open() as file:
            self._format = formats.told(file)
        if self._format is not None:
            return "text"
        with self._open() as file:
            framing = serial.told(file)
        if framing is None:
            raise SetupError(f"{self.path}: has no frame; {KNOWN}")
        return framing

    def _in_place(self) -> Path:
        """The file, or one with what comes through a pipe."""
        if self.path.is_fifo():
            with self.path.open("rb") as file:
                return self._copied(file)
        if self.path.exists() and not self.path.is_file():
            raise SetupError(
                f"{self.path}: is no file; of a session, name its frames.log or serial.bin"
            )
        return self.path

    def _copied(self, file: Readable) -> Path:
        copy = Path(self._kept.enter_context(tempfile.TemporaryDirectory(prefix="taxeld-"))) / "log"
        with copy.open("wb") as written:
            while data := file.read(BLOCK):
                written.write(data)
        return copy

    @contextmanager
    def _open(self, damage: Damage | None = None) -> Iterator[Readable]:
        if not self._is_packed:
            with self._file.open("rb") as file:
                yield file
        else:
            with gzip.open(self._file, "rb") as packed:
                yield _Packed(packed, damage or Damage())

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = error.strerror or error
            raise SetupError(f"{self.path}: unreadable log ({reason})") from None


class _Packed:
    """What is packed with gzip, up to where it is damaged or cut."""

    def __init__(self, file: gzip.GzipFile, damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self._at = 0

    def read(self, size: int, /) -> bytes:
        try:
            data = self._file.read1(size)  # of `read`, an error takes what came before it along
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            self._damage.at(f"behind byte {self._at} unpacked", str(error))
            return b""
        self._at += len(data)
        return data


class Pass:
    """A pass through a log: its frames, of one interface or of all, through a decoder."""

    def __init__(self, log_file: LogFile, decoder: ScanDecoder, interface: str = "") -> None:
        self.damage = Damage()
        self._log = log_file
        self._decoder = decoder
        self._interface = interface
        self._wire: Wire | None = None
        if log_file.framing:
            self._wire = Wire(SourceConfig(kind="serial", framing=log_file.framing), decoder)

    def heard(self) -> Iterator[Heard]:
        """Packets and scans as the decoder makes them. Raises SetupError."""
        if self._wire is not None:
            for chunk in self._log.chunks(self.damage):
                yield from self._wire.data(chunk.data, chunk.t)
            return
        feed, drop, wanted = self._decoder.feed, self._decoder.drop_foreign, self._interface
        for batch in self._log.frames(self.damage):
            for name, frame in batch:
                if wanted and name != wanted:
                    continue
                if frame is None:
                    drop()
                    continue
                packet, scans = feed(frame)
                if packet is not None or scans:
                    yield Heard(packet, scans)

    def stats(self) -> dict[str, object]:
        """The decoder's counters, those of a serial line, and how much was damaged."""
        stats = self._decoder.stats() if self._wire is None else self._wire.stats()
        return {**stats, "bad_lines": self.damage.count}
