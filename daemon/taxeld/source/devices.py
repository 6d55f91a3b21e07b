"""Devices that a skin hangs on: a CAN interface of python-can's, or a serial line.

Neither reading nor writing waits. What has arrived comes out as frames or bytes, with its time. A
device that is lost raises LostError, whatever its driver raises.
"""

import contextlib
import errno
import logging
import os
import termios
import time
from typing import Any, Protocol

import can
import serial

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.dialects import ToFrames
from taxeld.source.outbox import Unit
from taxeld.source.session import Chunk
from taxeld_protocol import serial_link, slcan
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER
from taxeld_protocol.frames import Frame

logging.getLogger("can").addHandler(logging.NullHandler())  # what goes wrong is said once, here

FRAMES_PER_POLL = 1000  # a flooded bus may not hold the loop; the rest waits for the next tick
BYTES_PER_POLL = 65536
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is of no Unix clock, but of the adapter's own
ADAPTER_BAUD = 115_200  # of an SLCAN adapter whose channel names no other: /dev/ttyACM0@921600
NO_DATA_FRAME = (b"r", b"R", b"d", b"D", b"b", b"B")  # SLCAN lines: remote and FD frames

LOCKED = "another process has it open"
ABSENT = "it is not there; is it plugged in?"
DENIED = "permission denied; is this user in the group that owns it?"
REASONS = {  # in place of what the system calls them
    errno.EAGAIN: LOCKED,
    errno.EBUSY: LOCKED,
    errno.ENOENT: ABSENT,
    errno.ENODEV: ABSENT,
    errno.ENXIO: ABSENT,
    errno.EACCES: DENIED,
    errno.EPERM: DENIED,
    errno.ENOTTY: "it is no serial line",
    errno.EISDIR: "it is a directory",
}
FOR_A_PERSON = {errno.EACCES, errno.EPERM, errno.ENOTTY, errno.EISDIR}  # no waiting mends these


class LostError(Exception):
    """The device is gone."""


class AwayError(SetupError):
    """A device that is missing or busy: it may be had later."""


class Device(Protocol):
    """An open CAN interface or serial line."""

    noise: int  # reads that could not be decoded, and
    foreign: int  # frames that are no classic data frames, since last taken

    def read(self) -> list[Frame] | list[Chunk]:
        """What has arrived. Raises LostError."""
        ...

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        """A request, to be broadcast."""
        ...

    def put(self, unit: Unit) -> Unit | None:
        """As `outbox.Taker` says."""
        ...

    def close(self, wait_s: float = 0.0) -> None:
        """Close; what was written last may take `wait_s` to get out, and is lost then."""
        ...


def open_device(config: SourceConfig, to_frames: ToFrames) -> Device:
    """The configured device, opened.

    Raises:
        AwayError: it is missing or busy.
        SetupError: it can never be opened so.
    """
    if config.kind == "serial":
        return SerialDevice(config, to_frames)
    return (SlcanDevice if config.interface == "slcan" else CanDevice)(config, to_frames)


class CanDevice:
    """Any interface that python-can knows."""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        self.noise = self.foreign = 0
        self._to_frames = to_frames
        self._bus = _open_bus(config)

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
                break
            if message is None:
                break
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

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        return [Unit(frame) for frame in self._to_frames(command, payload)]

    def put(self, unit: Unit) -> None:
        assert unit.frame is not None  # noqa: S101  (as packed)
        message = can.Message(
            arbitration_id=unit.frame.can_id,
            data=unit.frame.data,
            is_extended_id=unit.frame.extended,
        )
        try:
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError) as error:  # full or down: reading tells when it is gone
            raise BlockingIOError from error

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()


class SerialDevice:
    """A serial line: the native link, or SLCAN."""

    def __init__(
        self, config: SourceConfig, to_frames: ToFrames, path: str = "", baud: int = 0
    ) -> None:
        """`path`, `baud`: instead of the configured ones."""
        self.noise = self.foreign = 0
        self._to_frames = to_frames
        self._slcan = config.kind == "can" or config.framing == "slcan"
        where = path or config.channel
        try:
            self._port = serial.Serial(where, baud or config.baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise _unopened(where, error) from None
        if self._slcan:
            self._start(where, slcan.open_commands(config.bitrate, config.listen_only))

    def read(self) -> list[Frame] | list[Chunk]:
        data = self._receive()
        return [Chunk(time.time(), data)] if data else []

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        if self._slcan:  # a recording of a line holds what was read from it alone
            return [Unit(None, slcan.encode(f)) for f in self._to_frames(command, payload)]
        if command == LEAVE_BOOTLOADER:  # a hub that speaks this link runs its application
            return []
        return [Unit(None, serial_link.encode(command, payload, ihb=BROADCAST))]

    def put(self, unit: Unit) -> Unit | None:
        try:
            # not pyserial's `write`, which either waits or, told not to, spins while all is full
            taken = os.write(self._port.fileno(), unit.line)
        except BlockingIOError:
            raise
        except OSError as error:
            raise LostError from error
        if not taken:
            raise BlockingIOError
        return unit._replace(line=unit.line[taken:]) if taken < len(unit.line) else None

    def close(self, wait_s: float = 0.0) -> None:
        with contextlib.suppress(OSError, termios.error):
            deadline = time.monotonic() + wait_s
            while self._port.out_waiting and time.monotonic() < deadline:
                time.sleep(wait_s / 20.0)
            if self._port.out_waiting:  # else the kernel waits for it up to 30 s
                self._port.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._port.close()

    def _receive(self) -> bytes:
        try:
            # asked even when none wait: that is how a line that was unplugged shows
            return bytes(self._port.read(max(1, min(self._port.in_waiting, BYTES_PER_POLL))))
        except OSError as error:
            raise LostError from error

    def _start(self, where: str, commands: bytes) -> None:
        try:
            taken = os.write(self._port.fileno(), commands)
        except OSError as error:
            self._port.close()
            raise _unopened(where, error) from None
        if taken < len(commands):
            self._port.close()
            raise AwayError(f"source.channel: cannot open {where} (it takes no data)")


class SlcanDevice(SerialDevice):
    """An SLCAN adapter, as a bus. Python-can's own would wait for it at each request."""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        path, _, baud = config.channel.partition("@")
        if baud and not baud.isdecimal():
            raise SetupError(f"source.channel: {config.channel} must end with @ and a line speed")
        super().__init__(config, to_frames, path, int(baud or ADAPTER_BAUD))
        self._rest = b""

    def read(self) -> list[Frame]:
        data, now = self._receive(), time.time()
        lines, self._rest = slcan.split(self._rest + data)
        frames = []
        for line in lines:
            frame = slcan.parse(line, now)
            if frame is not None:
                frames.append(frame)
            elif line.startswith(NO_DATA_FRAME):
                self.foreign += 1
            elif line not in (b"", b"z", b"Z"):  # an adapter's answers
                self.noise += 1
        return frames

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        return [Unit(f, slcan.encode(f)) for f in self._to_frames(command, payload)]

    def close(self, wait_s: float = 0.0) -> None:
        with contextlib.suppress(OSError):
            os.write(self._port.fileno(), b"C\r")
        super().close(wait_s)


def _open_bus(config: SourceConfig) -> Any:
    where = f"{config.interface} {config.channel}"
    try:
        return can.Bus(interface=config.interface, channel=config.channel, bitrate=config.bitrate)
    except (can.CanInterfaceNotImplementedError, ImportError) as error:
        raise SetupError(f"source.interface: {_first_line(error)}") from None
    except Exception as error:  # each of python-can's interfaces raises its own
        raise _unopened(where, error) from None


def _unopened(where: str, error: Exception) -> SetupError:
    number = _errno(error)
    reason = REASONS.get(number) or (os.strerror(number) if number else _first_line(error))
    for_a_person = number in FOR_A_PERSON or (not number and isinstance(error, ValueError))
    kind = SetupError if for_a_person else AwayError
    return kind(f"source.channel: cannot open {where} ({reason})")


def _errno(error: BaseException | None) -> int:
    """The system's number of the fault behind an exception; 0 where there is none."""
    while error is not None:
        number = getattr(error, "errno", None) or next(iter(error.args), None)
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return 0


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
