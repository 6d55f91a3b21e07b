"""A serial line, locked while it is open; and a hub's own link on one. Nothing here waits."""

import contextlib
import os
import termios
import time

import serial

from taxeld.config.tables import SourceConfig
from taxeld.source.device import LostError, Noticed
from taxeld.source.dialects import ToFrames
from taxeld.source.opening import unopened
from taxeld.source.outbox import Unit
from taxeld.source.session import Chunk
from taxeld_protocol import serial_link
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER

BYTES_PER_POLL = 65536
SPEEDS = range(1200, 12_000_001)  # bit/s


def line_speed(text: str) -> int | None:
    """A line speed [bit/s] as a user writes it; None where the text is none."""
    digits = text.isdecimal() and len(text) <= len(str(SPEEDS[-1]))
    return int(text) if digits and int(text) in SPEEDS else None


class SerialLine:
    """An open serial line."""

    def __init__(self, where: str, baud: int) -> None:
        self.noticed = Noticed()
        try:
            self._port = serial.Serial(where, baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise unopened(where, error) from None

    def fileno(self) -> int:
        return int(self._port.fileno())

    def put(self, unit: Unit) -> Unit | None:
        taken = self._write(unit.line)
        if not taken:
            raise BlockingIOError
        return unit._replace(line=unit.line[taken:]) if taken < len(unit.line) else None

    def close(self, wait_s: float = 0.0) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._drain(wait_s)
            if self._port.out_waiting:  # otherwise the kernel waits for these up to 30 s
                self._port.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._port.close()

    def _receive(self) -> bytes:
        try:
            data = os.read(self._port.fileno(), BYTES_PER_POLL)
            # asks even when no bytes wait, because an unplugged line shows only then
            return data or bytes(self._port.read(1))
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LostError from error

    def _write(self, data: bytes) -> int:
        """Write without waiting; → the number of bytes taken."""
        try:
            # pyserial's `write` either waits or, told not to, spins while the line is full
            return os.write(self._port.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LostError from error

    def _drain(self, wait_s: float) -> None:
        """Give written bytes `wait_s` to leave."""
        deadline = time.monotonic() + wait_s
        while self._port.out_waiting and time.monotonic() < deadline:
            time.sleep(wait_s / 20.0)


class SerialDevice(SerialLine):
    """A hub's own link on a serial line."""

    waits_for = ""

    def __init__(self, config: SourceConfig, _: ToFrames) -> None:
        super().__init__(config.channel, config.baud)

    def read(self) -> list[Chunk]:
        data = self._receive()
        return [Chunk(time.time(), data)] if data else []

    def tend(self, now_s: float) -> None:
        """Do nothing: the bring-up asks a hub for everything."""

    @staticmethod
    def pack(command: int, payload: bytes) -> list[Unit]:
        # a recording of a line holds only the bytes read from it
        if command == LEAVE_BOOTLOADER:  # a hub that speaks this link runs its application
            return []
        return [Unit(None, serial_link.encode(command, payload, ihb=BROADCAST))]
