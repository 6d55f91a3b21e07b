"""Devices that a skin hangs on: a CAN interface of python-can's, or a serial line.

Reading never blocks. What a device says goes out as frames or bytes, with its time; a device that
is gone raises LostError, whatever its driver calls that.
"""

import contextlib
import logging
import time
from typing import Any, Protocol

import can
import serial

from taxeld.config import SourceConfig
from taxeld.dialects import ToFrames
from taxeld.errors import SetupError
from taxeld.session import Chunk
from taxeld_protocol import serial_link, slcan
from taxeld_protocol.cyskin import BROADCAST
from taxeld_protocol.frames import Frame

logging.getLogger("can").addHandler(logging.NullHandler())  # what goes wrong is said once, here

FRAMES_PER_POLL = 1000  # a flooded bus may not hold the loop; the rest waits for the next tick
BYTES_PER_POLL = 65536
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is of no Unix clock, but of the adapter's own


class LostError(Exception):
    """The device is gone."""


class Device(Protocol):
    """An open CAN interface or serial line."""

    noise: int  # reads that could not be decoded, and
    foreign: int  # frames that are no classic data frames, since last taken

    def read(self) -> list[Frame] | list[Chunk]:
        """What has arrived. Raises LostError."""
        ...

    def write(self, command: int, payload: bytes) -> list[Frame]:
        """Broadcast a request; → the frames that carried it on a bus. Raises LostError."""
        ...

    def close(self) -> None: ...


class CanDevice:
    """Any interface that python-can knows."""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        self.noise = self.foreign = 0
        self._to_frames = to_frames
        self._bus = _open_bus(config)
        self._port = getattr(self._bus, "serialPortOrig", None)  # of slcan

    def read(self) -> list[Frame]:
        frames = []
        now = time.time()
        for _ in range(FRAMES_PER_POLL):
            try:
                # not `recv`, which measures its time-out on the wall clock and waits for an hour
                # where that is set back by one
                message, _ = self._bus._recv_internal(0.0)
            except (can.CanError, OSError, ValueError, IndexError) as error:
                if not isinstance(error.__cause__ or error, (ValueError, IndexError)):
                    raise LostError from error
                self.noise += 1
                self._forget_line()
                break
            if message is None:  # nothing there; or, on slcan, a line that is no frame
                if not self._waiting():
                    break
                continue
            if message.is_error_frame or message.is_remote_frame or message.is_fd:
                self.foreign += 1
                continue
            t = message.timestamp
            frames.append(
                Frame(
                    t if abs(t - now) < FOREIGN_CLOCK_S else now,
                    message.arbitration_id,
                    bytes(message.data),
                    message.is_extended_id,
                )
            )
        return frames

    def write(self, command: int, payload: bytes) -> list[Frame]:
        now = time.time()
        frames = [frame._replace(t=now) for frame in self._to_frames(command, payload)]
        for frame in frames:
            message = can.Message(
                arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
            )
            try:
                self._bus.send(message, timeout=0.0)
            except (can.CanError, OSError) as error:
                if self._port is None:  # a bus that is full or down: recv tells when it is gone
                    raise BlockingIOError from error
                raise LostError from error
        return frames

    def close(self) -> None:
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _waiting(self) -> bool:
        try:
            return self._port is not None and bool(self._port.in_waiting)
        except OSError as error:
            raise LostError from error

    def _forget_line(self) -> None:
        """Python-can's slcan keeps a line that it cannot decode, and would try it for ever."""
        if self._port is not None:
            with contextlib.suppress(can.CanError, OSError):
                self._bus.flush()


class SerialDevice:
    """A serial line: the native link, or SLCAN."""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        self.noise = self.foreign = 0
        self._to_frames = to_frames
        self._slcan = config.framing == "slcan"
        try:
            self._port = serial.Serial(
                config.channel, config.baud, timeout=0, write_timeout=0.1, exclusive=True
            )
            if self._slcan:
                self._port.write(slcan.open_commands(config.bitrate, config.listen_only))
        except (OSError, ValueError) as error:
            raise SetupError(f"source.channel: cannot open {config.channel} ({error})") from None

    def read(self) -> list[Chunk]:
        try:
            # asked even when none wait: that is how a line that was unplugged shows
            data = self._port.read(max(1, min(self._port.in_waiting, BYTES_PER_POLL)))
        except OSError as error:
            raise LostError from error
        return [Chunk(time.time(), data)] if data else []

    def write(self, command: int, payload: bytes) -> list[Frame]:
        if self._slcan:
            line = b"".join(map(slcan.encode, self._to_frames(command, payload)))
        else:
            line = serial_link.encode(command, payload, ihb=BROADCAST)
        try:
            self._port.write(line)
        except serial.SerialTimeoutException as error:
            raise BlockingIOError from error
        except OSError as error:
            raise LostError from error
        return []  # a recording of a line holds what was read from it alone

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


def _open_bus(config: SourceConfig) -> Any:
    extra: dict[str, Any] = {}
    if config.interface == "slcan":
        extra = {"sleep_after_open": 0.0, "timeout": 0.0, "listen_only": config.listen_only}
    where = f"{config.interface} {config.channel}"
    try:
        return can.Bus(
            interface=config.interface, channel=config.channel, bitrate=config.bitrate, **extra
        )
    except can.CanInterfaceNotImplementedError as error:
        raise SetupError(f"source.interface: {error}") from None
    except Exception as error:  # each of python-can's interfaces raises its own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SetupError(f"source.channel: cannot open {where} ({reason})") from None
