"""Sources of scans: CAN through python-can, the native serial link, or a recorded session.

A source is polled once a tick and never blocks. What arrives damaged is counted by the decoder.
"""

import contextlib
import time
from pathlib import Path
from typing import Any, Protocol

import can
import serial

from taxeld import dialects, session
from taxeld.bring_up import Request
from taxeld.config import SourceConfig
from taxeld.dialects import Dialect
from taxeld.errors import SetupError
from taxeld.layout import Layout
from taxeld_protocol import serial_link
from taxeld_protocol.cyskin import BROADCAST, Packet
from taxeld_protocol.decoder import Decoder, Scan, ScanDecoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import SerialReader

FRAMES_PER_POLL = 1000  # a flooded bus may not hold the loop; the rest waits for the next tick
BYTES_PER_POLL = 65536


class Source(Protocol):
    """What the loop asks of a source."""

    decoder: ScanDecoder
    io_errors: int

    def poll(self, now_s: float) -> list[Scan]:
        """Scans that have arrived; `now_s` is monotonic."""
        ...

    def close(self) -> None: ...


def open_source(config: SourceConfig, layout: Layout) -> Source:
    """The configured source, opened.

    Raises:
        SetupError: the device or session cannot be opened.
    """
    if config.kind == "can":
        return CanSource(config, dialects.live(config, layout))
    if config.kind == "serial":
        return SerialSource(config, dialects.live(config, layout))
    frames = session.read_frames(Path(config.path) / session.FRAMES)
    return ReplaySource(frames, dialects.listener(config, layout))


class _Live:
    """What CAN and serial share: bring-up, and scans as packets complete them."""

    def __init__(self, dialect: Dialect) -> None:
        self.decoder = dialect.decoder
        self.io_errors = 0
        self._bring_up = dialect.bring_up

    def poll(self, now_s: float) -> list[Scan]:
        scans: list[Scan] = []
        requests: list[Request] = []
        for packet, ended in self._receive():
            scans += ended
            if packet is not None and self._bring_up is not None:
                requests += self._bring_up.on_packet(packet)
        if self._bring_up is not None:
            if scans:
                self._bring_up.on_scan(now_s)
            requests += self._bring_up.due(now_s)
        for request in requests:
            self._send(*request)
        return scans

    def close(self) -> None:
        if self._bring_up is not None:
            for request in self._bring_up.stop():
                self._send(*request)
        self._shut()

    def _receive(self) -> list[tuple[Packet | None, list[Scan]]]:
        raise NotImplementedError

    def _send(self, command: int, payload: bytes) -> None:
        raise NotImplementedError

    def _shut(self) -> None:
        raise NotImplementedError


class CanSource(_Live):
    """Frames of any interface that python-can knows."""

    def __init__(self, config: SourceConfig, dialect: Dialect) -> None:
        super().__init__(dialect)
        self._to_frames = dialect.to_frames
        self._bus = _open_bus(config)
        self._port = getattr(self._bus, "serialPortOrig", None)  # of slcan

    def _receive(self) -> list[tuple[Packet | None, list[Scan]]]:
        out = []
        for _ in range(FRAMES_PER_POLL):
            try:
                message = self._bus.recv(0.0)
            except (can.CanError, OSError, ValueError, IndexError):
                self.io_errors += 1
                self._flush()
                break
            if message is None:  # nothing there; or, on slcan, a line that is no frame
                if self._port is None or not self._port.in_waiting:
                    break
                continue
            if message.is_error_frame or message.is_remote_frame or message.is_fd:
                self.decoder.drop_foreign()
                continue
            frame = Frame(
                message.timestamp,
                message.arbitration_id,
                bytes(message.data),
                message.is_extended_id,
            )
            out.append(self.decoder.feed(frame))
        return out

    def _send(self, command: int, payload: bytes) -> None:
        for frame in self._to_frames(command, payload):
            message = can.Message(
                arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
            )
            try:
                self._bus.send(message, timeout=0.0)
            except (can.CanError, OSError):
                self.io_errors += 1

    def _flush(self) -> None:
        """Drop a line that python-can's slcan cannot decode: it would try it again for ever."""
        with contextlib.suppress(can.CanError, OSError):
            if self._port is not None:
                self._bus.flush()

    def _shut(self) -> None:
        try:
            self._bus.shutdown()
        except (can.CanError, OSError):
            self.io_errors += 1


class SerialSource(_Live):
    """Packets of the native serial link."""

    def __init__(self, config: SourceConfig, dialect: Dialect) -> None:
        super().__init__(dialect)
        assert isinstance(dialect.decoder, Decoder)  # noqa: S101  (the configuration looked)
        self._on_packet = dialect.decoder.on_packet
        try:
            self._port = serial.Serial(config.channel, config.baud, timeout=0, write_timeout=0.1)
        except (OSError, ValueError) as error:
            raise SetupError(f"source.channel: cannot open {config.channel} ({error})") from None
        self.reader = SerialReader()

    def _receive(self) -> list[tuple[Packet | None, list[Scan]]]:
        try:
            data = self._port.read(BYTES_PER_POLL)
        except OSError:
            self.io_errors += 1
            return []
        packets = self.reader.feed(data, time.time())
        return [(packet, self._on_packet(packet)) for packet in packets]

    def _send(self, command: int, payload: bytes) -> None:
        try:
            self._port.write(serial_link.encode(command, payload, ihb=BROADCAST))
        except OSError:
            self.io_errors += 1

    def _shut(self) -> None:
        self._port.close()


class ReplaySource:
    """A recorded log at the pace it was recorded, its times moved to now."""

    def __init__(self, frames: list[Frame], decoder: ScanDecoder) -> None:
        self.decoder = decoder
        self.io_errors = 0
        self.shift_s: float | None = None  # recorded time → Unix time, known from the first poll
        self._frames = frames
        self._at = 0
        self._start_s = 0.0

    @property
    def finished(self) -> bool:
        return self._at >= len(self._frames)

    def poll(self, now_s: float) -> list[Scan]:
        first_t = self._frames[0].t
        if self.shift_s is None:
            self.shift_s = time.time() - first_t
            self._start_s = now_s
        scans: list[Scan] = []
        while not self.finished and self._frames[self._at].t - first_t <= now_s - self._start_s:
            frame = self._frames[self._at]
            scans += self.decoder.feed(frame._replace(t=frame.t + self.shift_s))[1]
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
