"""Sources of scans: CAN through python-can, a serial line, or a recorded session.

A source is polled once a tick and never blocks. A device that goes away is opened again with
growing pauses, and the skin on it is brought up anew; what arrives damaged is counted.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import can
import serial

from taxeld import dialects, session
from taxeld.bring_up import Request
from taxeld.config import SourceConfig
from taxeld.dialects import Dialect, ToFrames
from taxeld.errors import SetupError
from taxeld.layout import Layout
from taxeld.session import Chunk, Recorder
from taxeld.wire import Heard, Wire
from taxeld_protocol import serial_link, slcan
from taxeld_protocol.cyskin import BROADCAST
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame

FRAMES_PER_POLL = 1000  # a flooded bus may not hold the loop; the rest waits for the next tick
BYTES_PER_POLL = 65536
REOPEN_S = (0.2, 5.0)  # the first pause before a lost device is opened again, and the longest


@dataclass(slots=True)
class SourceCounters:
    """Since start."""

    lost: int = 0  # times the device went away
    reopened: int = 0
    unsent: int = 0  # requests that the device did not take
    noise: int = 0  # reads that python-can could not decode


class Source(Protocol):
    """What the loop asks of a source."""

    wire: Wire
    counters: SourceCounters

    def poll(self, now_s: float) -> list[Scan]:
        """Scans that have arrived; `now_s` is monotonic."""
        ...

    def close(self) -> None: ...


def open_source(config: SourceConfig, layout: Layout, recorder: Recorder | None = None) -> Source:
    """The configured source, opened; `recorder` hears all that goes over its wire.

    Raises:
        SetupError: the device or session cannot be opened.
    """
    if config.kind == "replay":
        wire = Wire(config, dialects.listener(config, layout))
        return ReplaySource(session.read_input(Path(config.path)), wire)
    device = _CanDevice if config.kind == "can" else _SerialDevice
    return LiveSource(config, dialects.live(config, layout), device, recorder)


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


class LiveSource:
    """A device that may go and come, and the bring-up of the skin behind it."""

    def __init__(
        self,
        config: SourceConfig,
        dialect: Dialect,
        device: Callable[[SourceConfig, ToFrames], Device],
        recorder: Recorder | None,
    ) -> None:
        self.wire = Wire(config, dialect.decoder)
        self.counters = SourceCounters()
        self._open: Callable[[], Device] = lambda: device(config, dialect.to_frames)
        self._recorder = recorder
        self._bring_up = dialect.bring_up
        self._device: Device | None = self._open()
        self._pause_s, self._next_open_s = REOPEN_S[0], 0.0

    def poll(self, now_s: float) -> list[Scan]:
        if self._device is None:
            self._reopen(now_s)
        if self._device is None:
            return []
        try:
            return self._exchange(self._device, now_s)
        except LostError:
            self._lose(now_s)
            return []

    def close(self) -> None:
        if self._device is None:
            return
        with contextlib.suppress(LostError):
            for request in self._bring_up.stop() if self._bring_up else []:
                self._send(self._device, request)
        self._device.close()

    def _exchange(self, device: Device, now_s: float) -> list[Scan]:
        scans: list[Scan] = []
        requests: list[Request] = []
        for packet, ended in self._hear(device):
            scans += ended
            if packet is not None and self._bring_up is not None:
                requests += self._bring_up.on_packet(packet)
        self.counters.noise += device.noise
        for _ in range(device.foreign):
            self.wire.decoder.drop_foreign()
        device.noise = device.foreign = 0
        if self._bring_up is not None:
            if scans:
                self._bring_up.on_scan(now_s)
            requests += self._bring_up.due(now_s)
        for request in requests:
            self._send(device, request)
        return scans

    def _hear(self, device: Device) -> list[Heard]:
        heard: list[Heard] = []
        for item in device.read():
            if self._recorder is not None:
                self._recorder.take(item)
            heard += self.wire.take(item, item.t)
        return heard

    def _send(self, device: Device, request: Request) -> None:
        try:
            frames = device.write(*request)
        except BlockingIOError:
            self.counters.unsent += 1
            return
        if self._recorder is not None:
            for frame in frames:
                self._recorder.take(frame)

    def _lose(self, now_s: float) -> None:
        assert self._device is not None  # noqa: S101  (only an open device is lost)
        self.counters.lost += 1
        self._device.close()
        self._device = None
        self._next_open_s = now_s + self._pause_s

    def _reopen(self, now_s: float) -> None:
        if now_s < self._next_open_s:
            return
        try:
            self._device = self._open()
        except SetupError:
            self._pause_s = min(2.0 * self._pause_s, REOPEN_S[1])
            self._next_open_s = now_s + self._pause_s
            return
        self._pause_s = REOPEN_S[0]
        self.counters.reopened += 1
        if self._bring_up is not None:
            self._bring_up.restart()


class _CanDevice:
    """Any interface that python-can knows."""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        self.noise = self.foreign = 0
        self._to_frames = to_frames
        self._bus = _open_bus(config)
        self._port = getattr(self._bus, "serialPortOrig", None)  # of slcan

    def read(self) -> list[Frame]:
        frames = []
        for _ in range(FRAMES_PER_POLL):
            try:
                message = self._bus.recv(0.0)
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
            frames.append(
                Frame(
                    message.timestamp,
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


class _SerialDevice:
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


class ReplaySource:
    """A recorded session at the pace it was recorded, its times moved to now."""

    def __init__(self, items: list[Frame] | list[Chunk], wire: Wire) -> None:
        self.wire = wire
        self.counters = SourceCounters()
        self.shift_s: float | None = None  # recorded time → Unix time, known from the first poll
        self._items = items
        self._at = 0
        self._start_s = 0.0

    @property
    def finished(self) -> bool:
        return self._at >= len(self._items)

    def poll(self, now_s: float) -> list[Scan]:
        first_t = self._items[0].t
        if self.shift_s is None:
            self.shift_s = time.time() - first_t
            self._start_s = now_s
        scans: list[Scan] = []
        while not self.finished and self._items[self._at].t - first_t <= now_s - self._start_s:
            item = self._items[self._at]
            for heard in self.wire.take(item, item.t + self.shift_s):
                scans += heard.scans
            self._at += 1
        return scans

    def close(self) -> None:
        """Nothing is held open."""


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
