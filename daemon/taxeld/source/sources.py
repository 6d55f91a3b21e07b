"""Sources of scans: a CAN interface, a serial line, or an array.

A source is polled at every pass of the loop and never blocks. A device that is gone, or not there
yet, is opened again with growing pauses, and the skin on it is brought up anew; damaged input is
counted.
"""

import contextlib
import logging
import math
import time
from collections.abc import Callable, Mapping

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.source import module_order
from taxeld.source.array_source import ArraySource
from taxeld.source.bring_up import BringUp
from taxeld.source.device import AwayError, Device, LostError, Noticed
from taxeld.source.devices import open_device
from taxeld.source.module_order import Listening
from taxeld.source.outbox import PATIENCE_S, Outbox
from taxeld.source.recorder import Recorder
from taxeld.source.session import Chunk, Items, joined
from taxeld.source.source import Source
from taxeld.source.wire import Wire
from taxeld_protocol import cyskin
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import NAMES, wired

REOPEN_S = (0.2, 1.0)  # first and longest pause before a lost device is opened again
CLOSE_S = 0.2  # time for the last requests to leave the device
FRAME_BITS = 116  # a frame with 8 bytes and a short id, with the stuff bits of usual readings

log = logging.getLogger(__name__)


def open_source(
    config: SourceConfig,
    layout: Layout,
    recorder: Recorder | None = None,
    *,
    wait: bool = False,
) -> Source:
    """The configured source. `recorder` gets all frames or bytes of the wire. With `wait`, a
    missing or busy device is opened as soon as possible, instead of raising.

    Raises:
        SetupError: the device cannot be opened.
    """
    if config.kind == "array":
        return ArraySource(config, layout, recorder)
    return LiveSource(config, layout, open_device, recorder, wait=wait)


def live(config: SourceConfig, layout: Layout) -> tuple[Decoder, BringUp | None]:
    """The decoder of a live skin, and its bring-up; None where something else starts the skin.

    Raises:
        SetupError: the layout is no hub's, its scans are more than the bus carries, or none of the
            listed modules is in it.
    """
    least_ms = least_period_ms(config, layout)
    if config.period_ms < least_ms:
        rate = 1000 * _frames(layout) / config.period_ms
        raise SetupError(
            f"source.period_ms: {len(wired(layout.uid.tolist()))} modules every {config.period_ms} "
            f"ms are {rate:.0f} frames/s, and a bus of {config.bitrate} bit/s carries "
            f"{config.bitrate // FRAME_BITS}: at least {least_ms} ms"
        )
    if any(int(uid) & 0xF >= NAMES for uid in layout.uid):
        raise SetupError(
            "skin.layout: its UIDs are of no module, which has taxels "
            f"1..{NAMES - 1}: it is of an array (source.kind)"
        )
    period_s = config.period_ms / 1000.0
    if config.listen_only:
        return Decoder(module_order.given(config, layout).of, period_s), None
    # a bring-up asks the hubs for their modules, so the decoder must not guess them
    decoder = Decoder(period_s=period_s)
    return decoder, BringUp(decoder, config.period_ms, {int(uid) >> 4 for uid in layout.uid})


def least_period_ms(config: SourceConfig, layout: Layout) -> int:
    """The shortest period at which a CAN bus carries the layout's scans; 0 without a bus."""
    if config.kind == "serial":
        return 0
    return math.ceil(1000 * _frames(layout) * FRAME_BITS / config.bitrate)


def _frames(layout: Layout) -> int:
    """The least frames of a scan."""
    return cyskin.scan_frames(sum(module.channels for module in wired(layout.uid.tolist())))


class LiveSource(Source):
    """A device that may go and come back, and the bring-up of the skin behind it."""

    def __init__(
        self,
        config: SourceConfig,
        layout: Layout,
        device: Callable[[SourceConfig], Device],
        recorder: Recorder | None,
        *,
        wait: bool = False,
    ) -> None:
        self._decoder, self._bring_up = live(config, layout)
        super().__init__(Wire(self._decoder))
        self._open: Callable[[], Device] = lambda: device(config)
        self._recorder = recorder
        self._listening = Listening(self._decoder)
        self._outbox: Outbox | None = None
        self._held: Items = []  # items read from the device and not decoded yet
        self._failed: LostError | None = None  # loss of the device, after the held items
        self._pause_s, self._next_open_s = REOPEN_S[0], 0.0
        self._amiss: dict[str, str] = {}  # a line on each subject that was amiss
        self._due_s, self._behind_s = 0.0, 0.0  # the bring-up's time, and how far it is behind
        self._sent_s = 0.0  # time when all requests had left
        try:
            self._take(self._open())
        except SetupError as error:
            if not (wait and isinstance(error, AwayError)):
                raise
            self._wait(str(error), -math.inf)

    @property
    def is_busy(self) -> bool:  # type: ignore[override]
        return bool(self._outbox) or (self.device is not None and self.device.fileno() < 0)

    @property
    def firmware(self) -> Mapping[str, str]:  # type: ignore[override]
        return self._bring_up.firmware if self._bring_up else {}

    def gather(self) -> int:
        if self.device is not None and self._failed is None:
            try:
                self._held = [*self._held, *self.device.read()]
            except LostError as error:
                self._failed = error
        return sum(len(item.data) if isinstance(item, Chunk) else 1 for item in self._held)

    def poll(self, now_s: float) -> list[Scan]:
        if self.device is None:
            self._reopen(now_s)
        if self.device is None or self._outbox is None:
            return []
        try:
            return self._exchange(self.device, self._outbox, now_s)
        except LostError as error:
            self._lose(self.device, str(error.__cause__ or "no cause is known"), now_s)
            return []

    def close(self) -> None:
        if self.device is not None and self._outbox is not None:
            self._outbox.clear()
            self._stop(self._outbox)
            self.device.close(CLOSE_S)
            self.device = None

    def _take(self, device: Device) -> None:
        self.device, self._outbox, self._failed = device, Outbox(device), None
        self._pause_s = REOPEN_S[0]
        self.waits_for = ""
        self._amiss.clear()

    def _exchange(self, device: Device, outbox: Outbox, now_s: float) -> list[Scan]:
        """One turn: hear what has come, and send what is due. Raises LostError."""
        scans: list[Scan] = []
        bring_up = self._bring_up
        items = self._read()
        decoded = self.wire.take(items)
        if decoded or (items and isinstance(items[0], Frame)):  # a line's bytes may be answers
            self.bus.hear(now_s)
        for packet, ended in decoded:
            scans += ended
            if packet is not None and bring_up is not None:
                bring_up.on_packet(packet)
        if bring_up is not None:
            if not outbox:
                self._sent_s = now_s
            # the bring-up's clock stops while requests wait to be sent
            waits = bool(outbox) and now_s < self._sent_s + PATIENCE_S
            self._behind_s = now_s - self._due_s if waits else self._behind_s
            self._due_s = now_s - self._behind_s
            for scan in scans:
                bring_up.on_scan(scan.ihb, self._due_s)
            if not waits:
                outbox.add(bring_up.due(self._due_s), now_s)
            for line in bring_up.news():
                log.info("%s", line)
            lacks, device.is_starting = bring_up.waits_for, bring_up.is_starting
        else:
            self.fault, lacks = self._listening.fault(now_s), self._listening.refusal
        device.tend(now_s)
        self._follow(device, now_s)
        amiss = {"bus": self.bus.line(now_s), "device": device.waits_for, "skin": lacks}
        for subject, line in amiss.items():
            self._heed(subject, line)
        if not self.bus.is_mute(now_s):
            del amiss["bus"]
        self.waits_for = "; ".join(filter(None, amiss.values()))
        self._flush(outbox, now_s)
        return scans

    def _read(self) -> Items:
        """The items that were gathered, or that wait in the device. Raises LostError."""
        if not self._held:
            self.gather()
        items, self._held = joined(self._held), []
        if self._failed is not None and not items:
            raise self._failed
        if self._recorder is not None:
            for item in items:
                self._recorder.take(item)
        return items

    def _follow(self, device: Device, now_s: float) -> None:
        noticed, device.noticed = device.noticed, Noticed()
        self.bus.take(noticed.bus, now_s)
        for _ in range(noticed.foreign):
            self._decoder.drop_foreign()
        for line in noticed.lines:
            log.warning("%s", line)

    def _flush(self, outbox: Outbox, now_s: float) -> None:
        try:
            for frame in outbox.flush(now_s) if outbox else ():
                if self._recorder is not None:
                    self._recorder.take(frame)
        finally:
            self.counters.unsent += outbox.dropped
            outbox.dropped = 0

    def _stop(self, outbox: Outbox) -> None:
        """Tell the skin to stop, if its device takes the request in time."""
        now_s = time.monotonic()
        outbox.add(self._bring_up.stop() if self._bring_up else [], now_s)
        with contextlib.suppress(LostError):
            self._flush(outbox, now_s)
            while outbox and time.monotonic() < now_s + CLOSE_S:
                time.sleep(CLOSE_S / 20.0)
                self._flush(outbox, now_s)

    def _lose(self, device: Device, reason: str, now_s: float) -> None:
        self.counters.lost += 1
        self.bus.take(device.noticed.bus, now_s)
        device.close()
        self.device = self._outbox = None
        self._next_open_s = now_s + self._pause_s
        self.waits_for = f"source.channel: the device went away ({reason})"
        log.warning("%s", self.waits_for)

    def _reopen(self, now_s: float) -> None:
        if now_s < self._next_open_s:
            return
        waited_for = self.waits_for
        try:
            self._take(self._open())
        except SetupError as error:
            self._wait(str(error), now_s)
            return
        self.counters.reopened += 1
        self.bus.recover(now_s)
        log.info("source.channel: is open, after: %s", waited_for)
        if self._bring_up is not None:
            self._bring_up.restart()

    def _wait(self, reason: str, now_s: float) -> None:
        self.counters.unopened += 1
        self._pause_s = min(2.0 * self._pause_s, REOPEN_S[1])
        self._next_open_s = now_s + self._pause_s
        if reason != self.waits_for:
            self.waits_for = reason
            log.warning("%s; waiting for it", reason)

    def _heed(self, subject: str, line: str) -> None:
        before, self._amiss[subject] = self._amiss.get(subject, ""), line
        if line and line != before:
            log.warning("%s", line)
        elif before and not line:
            log.info("no longer: %s", before)
