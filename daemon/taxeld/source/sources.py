"""Sources of scans: a hub's bus or line, or an array.

A source is polled at every pass of the loop and never blocks. A device that is gone, or not there
yet, is opened again with growing pauses, and the skin on it is brought up anew; damaged input is
counted.
"""

import contextlib
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.source import modules
from taxeld.source.bring_up import BringUp, Request
from taxeld.source.bus_faults import BusHealth
from taxeld.source.device import AwayError, Device, LostError, Noticed
from taxeld.source.links import LinkTable, joint
from taxeld.source.recorder import Recorder
from taxeld.source.session import Item, Late
from taxeld_protocol import cyskin
from taxeld_protocol.array import ArrayDecoder, ArrayFrame
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import NAMES, wired

REOPEN_S = (0.2, 1.0)  # first and longest pause before a lost device is opened again
CLOSE_S = 0.2  # time for the last requests to leave the device
PATIENCE_S = 1.0  # requests that wait longer are dropped; an adapter's channel opens in less
STOPPED_S = 0.25  # time without a poll after which the loop had been stopped,
STOPPED_PERIODS = 2  # or these scan periods, if they are longer
BACKLOG_S = 1.0  # most time in which a line then gives what had waited
QUIET_PERIODS = 0.5  # scan periods without data, after which nothing more had waited
FRAME_BITS = 116  # a frame with 8 bytes and a short id, with the stuff bits of usual readings
HELD_MAX = 256  # arrays between two polls; beyond, the oldest are lost
SILENT_S = 1.0  # without a good array for so long, a line says why
LINES_MAX = 20  # different lines on arrays that are logged, each once: others would be hidden

log = logging.getLogger(__name__)


@dataclass(slots=True)
class SourceCounters:
    """Counters of a source, since start."""

    lost: int = 0  # times the device was lost
    reopened: int = 0
    unopened: int = 0  # attempts to open it that failed
    unsent: int = 0  # requests that the device did not take in time
    late: int = 0  # scans that waited on a line while the loop was stopped: their times are unknown


class Source:
    """A source of scans, which is polled at every pass."""

    device: Device | None = None  # the open device; the loop waits on its descriptor
    is_busy = False  # whether it must be polled at every tick, as no descriptor would wake the loop
    is_coming = False  # whether the last poll took frames and no whole scan: more are on their way
    waits_for = ""  # a line on why no scans come; empty where nothing is amiss
    firmware: Mapping[str, str] = MappingProxyType({})  # short id of a hub → its versions, in words

    def __init__(
        self,
        decoder: Decoder | ArrayDecoder,
        skins: Mapping[int, Layout],
        recorder: Recorder | None,
    ) -> None:
        self.decoder = decoder
        self.links = LinkTable(skins)
        self.counters = SourceCounters()
        self.bus = BusHealth()  # of a CAN bus
        self._recorder = recorder

    def _record(self, items: Iterable[Item], t: float | None = None) -> None:
        if self._recorder is not None:
            for item in items:
                self._recorder.take(item, self.links.numbers[0], t)

    def poll(self, now_s: float) -> list[Scan]:
        """Take what has arrived; → the scans that it ends. `now_s` is monotonic."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop the skin and close the device, if there is one."""


def polled(sources: Sequence[Source], now_s: float) -> list[Scan]:
    """The scans of all links that have come by the monotonic time `now_s`."""
    return [scan for source in sources for scan in source.links.of(source.poll(now_s))]


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
        modules.check(config, layout)
        return Decoder(modules.known(config.modules), period_s), None
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

    decoder: Decoder

    def __init__(
        self,
        config: SourceConfig,
        skins: Mapping[int, Layout],
        device: Callable[[SourceConfig], Device],
        recorder: Recorder | None = None,
        *,
        wait: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`wait`: for a device that is missing or busy, which is opened as soon as possible, in
        place of raising.

        Raises:
            SetupError: the device cannot be opened, or the conditions of `live`.
        """
        self._clock = clock
        decoder, self._bring_up = live(config, joint(list(skins.values())))
        super().__init__(decoder, skins, recorder)
        self._open: Callable[[], Device] = lambda: device(config)
        self._requests = deque[Request]()  # requests that the device has not taken yet,
        self._given_up_s = math.inf  # and when they are given up
        self._pause_s, self._next_open_s = REOPEN_S[0], 0.0
        self._amiss: dict[str, str] = {}  # a line on each subject that was amiss
        period_s = config.period_ms / 1000.0
        stopped_s = max(STOPPED_S, STOPPED_PERIODS * period_s)
        self._stopped_s = stopped_s if config.is_unstamped else math.inf
        self._quiet_s = QUIET_PERIODS * period_s
        self._polled_s = math.inf  # time of the last poll of this device, or of its opening
        self._came_s = self._late_until_s = -math.inf  # when data came last; as of `_judge`
        try:
            self._take(self._open())
        except SetupError as error:
            if not (wait and isinstance(error, AwayError)):
                raise
            self._wait(str(error), -math.inf)

    @property
    def is_busy(self) -> bool:  # type: ignore[override]
        return bool(self._requests) or (self.device is not None and self.device.fileno() < 0)

    @property
    def firmware(self) -> Mapping[str, str]:  # type: ignore[override]
        return self._bring_up.firmware if self._bring_up else {}

    def poll(self, now_s: float) -> list[Scan]:
        self.is_coming = False
        if self.device is None:
            self._reopen(now_s)
        if self.device is None:
            return []
        try:
            return self._exchange(self.device, now_s)
        except LostError as error:
            self._lose(self.device, str(error.__cause__ or "no cause is known"), now_s)
            return []

    def close(self) -> None:
        """Tell the skin to stop, if its device takes the request in time, and close the device."""
        if self.device is None:
            return
        now_s = time.monotonic()
        self._requests.clear()
        if self._bring_up is not None:
            self._requests.append(self._bring_up.stop())
        with contextlib.suppress(LostError):
            self._flush(self.device)
            while self._requests and time.monotonic() < now_s + CLOSE_S:
                time.sleep(CLOSE_S / 20.0)
                self._flush(self.device)
        self.device.close(CLOSE_S)
        self.device = None

    def _take(self, device: Device) -> None:
        self.device = device
        self._requests.clear()
        self._pause_s = REOPEN_S[0]
        self._polled_s = self._clock()
        self.waits_for = ""
        self._amiss.clear()

    def _exchange(self, device: Device, now_s: float) -> list[Scan]:
        """One turn: hear what has come, and send what is due. Raises LostError."""
        is_late = self._judge(now_s)
        scans = self._hear(device, now_s, is_late=is_late)
        if self._bring_up is not None:
            lacks = self._ask(self._bring_up, scans, now_s)
            device.is_starting = self._bring_up.is_starting
        else:
            lacks = self.decoder.refusal or modules.unplaced(self.decoder)
        device.tend(now_s)
        noticed, device.noticed = device.noticed, Noticed()
        self.bus.take(noticed.bus, now_s)
        self.decoder.drop_foreign(noticed.foreign)
        for line in noticed.lines:
            log.warning("%s", line)
        amiss = {"bus": self.bus.line(now_s), "device": device.waits_for, "skin": lacks}
        for subject, line in amiss.items():
            self._heed(subject, line)
        if not self.bus.is_mute(now_s):
            del amiss["bus"]
        self.waits_for = "; ".join(filter(None, amiss.values()))
        self._flush(device)
        if is_late:
            self.counters.late += len(scans)
            scans = []
        return scans

    def _judge(self, now_s: float) -> bool:
        """Whether the data of this poll had waited while the loop was stopped. The system hands on
        such data bit by bit, until a pause shows that the rest comes as it is sent."""
        if now_s > self._polled_s + self._stopped_s:
            self._late_until_s = now_s + BACKLOG_S
        elif now_s > self._came_s + self._quiet_s:
            self._late_until_s = now_s
        self._polled_s = now_s
        return now_s < self._late_until_s

    def _hear(self, device: Device, now_s: float, *, is_late: bool) -> list[Scan]:
        """Decode what waits in the device; → scans. Raises LostError.

        `is_late`: as of `_judge`. Nothing tells when came what waited on the line, which dates its
        data when they are read; so all of it is read now.
        """
        items = [*device.read()]
        while is_late and (more := device.read()):
            items += more
        self._record([*items, Late(time.time())] if is_late else items)
        if items:
            self._came_s = now_s
        decoded = [*self.decoder.take(items)]
        if decoded or (items and isinstance(items[0], Frame)):  # a line's bytes may be answers
            self.bus.hear(now_s)
        if self._bring_up is not None:
            for packet, _ in decoded:
                self._bring_up.on_packet(packet)
        scans = [scan for _, ended in decoded for scan in ended]
        self.is_coming = bool(items) and not scans
        return scans

    def _ask(self, bring_up: BringUp, scans: Sequence[Scan], now_s: float) -> str:
        """Take the bring-up's requests, once its last ones have left; → what it lacks."""
        for scan in scans:
            bring_up.on_scan(scan.ihb, now_s)
        if now_s > self._given_up_s:
            self.counters.unsent += len(self._requests)
            self._requests.clear()
        if not self._requests:
            self._requests.extend(bring_up.due(now_s))
            self._given_up_s = now_s + PATIENCE_S
        return bring_up.waits_for

    def _flush(self, device: Device) -> None:
        """Send what the device takes. Raises LostError."""
        with contextlib.suppress(BlockingIOError):
            while self._requests:
                frame = device.send(*self._requests[0])
                self._requests.popleft()
                if frame is not None:
                    self._record([frame])

    def _lose(self, device: Device, reason: str, now_s: float) -> None:
        self.counters.lost += 1
        self.bus.take(device.noticed.bus, now_s)
        device.close()
        self.device = None
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


class ArraySource(Source):
    """Arrays that somebody else sends: the door hears and checks them, and wakes the loop."""

    decoder: ArrayDecoder

    def __init__(
        self,
        config: SourceConfig,
        skins: Mapping[int, Layout],
        recorder: Recorder | None = None,
        unix: Callable[[], float] = time.time,
    ) -> None:
        uids = joint(list(skins.values())).uid.tolist()
        super().__init__(ArrayDecoder(uids, config.array), skins, recorder)
        self._endpoint, self._unix = config.endpoint, unix
        self._held: deque[ArrayFrame] = deque(maxlen=HELD_MAX)
        self._good_s: float | None = None  # when a frame was used last
        self._said: set[str] = set()
        self._malformed, self._reason, self._connected = 0, "", False

    def hear(self, frame: ArrayFrame) -> None:
        """A frame has come by the door."""
        self._held.append(frame)

    def heed(self, *, connected: bool, malformed: int, reason: str) -> None:
        """The door's report: whether somebody sends, the number of messages that were no arrays,
        and why the last of them was not."""
        if malformed != self._malformed:
            self._say(f"source.endpoint: messages are no arrays: {reason}")
        self._malformed, self._connected = malformed, connected
        self._reason = f" (the last was none: {reason})" if reason else ""

    def poll(self, now_s: float) -> list[Scan]:
        self._good_s = now_s if self._good_s is None else self._good_s
        self.decoder.now_t = self._unix()
        scans: list[Scan] = []
        while self._held:
            frame = self._held.popleft()
            self._record([frame], self.decoder.now_t)
            scans += self.decoder.feed(frame)[1]
            if self.decoder.fault:
                self._say(self.decoder.fault)
        if scans:
            self._good_s, self.waits_for = now_s, ""
        elif now_s > self._good_s + SILENT_S:
            self.waits_for = self.decoder.fault or (
                f"source.endpoint: no array comes by {self._endpoint}{self._reason}"
                if self._connected
                else f"source.endpoint: nobody sends to {self._endpoint}"
            )
            self._say(self.waits_for)
        return scans

    def _say(self, line: str) -> None:
        """Log a line, once."""
        if line not in self._said and len(self._said) < LINES_MAX:
            self._said.add(line)
            log.warning("%s", line)
