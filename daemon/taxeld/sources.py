"""Sources of scans: CAN through python-can, a serial line, or a recorded session.

A source is polled once a tick and never blocks. A device that goes away is opened again with
growing pauses, and the skin on it is brought up anew; what arrives damaged is counted.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from taxeld import dialects, session
from taxeld.bring_up import Request
from taxeld.config import SourceConfig
from taxeld.devices import CanDevice, Device, LostError, SerialDevice
from taxeld.dialects import Dialect, ToFrames
from taxeld.errors import SetupError
from taxeld.layout import Layout
from taxeld.session import Chunk, Recorder
from taxeld.wire import Heard, Wire
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame

REOPEN_S = (0.2, 1.0)  # the first pause before a lost device is opened again, and the longest


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
    device = CanDevice if config.kind == "can" else SerialDevice
    return LiveSource(config, dialects.live(config, layout), device, recorder)


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
            for scan in scans:
                self._bring_up.on_scan(scan.ihb, now_s)
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
