"""A serial line, locked while it is open; and a hub's own link on one. Nothing here waits."""

import contextlib
import os
import termios
import time

import serial

from taxeld.config.tables import SourceConfig
from taxeld.source.device import Device, LostError, Piece, unopened
from taxeld.source.session import Chunk
from taxeld_protocol import serial_link, slcan
from taxeld_protocol.cyskin import LEAVE_BOOTLOADER
from taxeld_protocol.frames import Frame

BYTES_PER_POLL = 65536
SPEEDS = range(1200, 12_000_001)  # bit/s


def line_speed(text: str) -> int | None:
    """A line speed [bit/s] as a user writes it; None where the text is none."""
    digits = text.isdecimal() and len(text) <= len(str(SPEEDS[-1]))
    return int(text) if digits and int(text) in SPEEDS else None


class SerialLine(Device):
    """An open serial line."""

    def __init__(self, where: str, baud: int) -> None:
        super().__init__()
        self._rest = b""  # rest of a piece of which the line has taken a part
        try:
            self._port = serial.Serial(where, baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise unopened(where, error) from None

    def fileno(self) -> int:
        return int(self._port.fileno())

    def tend(self, now_s: float) -> None:  # noqa: ARG002
        self._send_rest()

    def put(self, piece: Piece) -> None:
        data = slcan.encode(piece) if isinstance(piece, Frame) else piece
        taken = 0 if self._send_rest() else self._write(data)
        if not taken:
            raise BlockingIOError
        self._rest = data[taken:]

    def close(self, wait_s: float = 0.0) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._drain(wait_s)
            if self._port.out_waiting:  # otherwise the kernel waits for these up to 30 s
                self._port.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._port.close()

    def _send_rest(self) -> bytes:
        """Send what is left of the last piece; → the part that is left now. Raises LostError."""
        if self._rest:
            self._rest = self._rest[self._write(self._rest) :]
        return self._rest

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
        """Write without waiting; → the number of bytes taken. Raises LostError."""
        try:
            # pyserial's `write` either waits or, told not to, spins while the line is full
            return os.write(self._port.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LostError from error

    def _drain(self, wait_s: float) -> None:
        deadline = time.monotonic() + wait_s
        with contextlib.suppress(LostError):
            while (self._send_rest() or self._port.out_waiting) and time.monotonic() < deadline:
                time.sleep(wait_s / 20.0)


class SerialDevice(SerialLine):
    """A hub's own link on a serial line."""

    def __init__(self, config: SourceConfig) -> None:
        super().__init__(config.channel, config.baud)

    def read(self) -> list[Chunk]:
        data = self._receive()
        return [Chunk(time.time(), data)] if data else []

    def pack(self, to: int, body: bytes) -> list[bytes]:
        if to == LEAVE_BOOTLOADER:  # a hub that speaks this link runs its application
            return []
        return [serial_link.encode(body[0], body[1:], ihb=to)]
