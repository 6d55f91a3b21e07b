"""Arrays of any skin, which the door hears: it checks each message, and here they become scans."""

import logging
import time
from collections import deque
from collections.abc import Callable

from taxeld.config.tables import SourceConfig
from taxeld.layout.layout import Layout
from taxeld.source.recorder import Recorder
from taxeld.source.source import Source
from taxeld.source.wire import Wire
from taxeld_protocol.array import ArrayDecoder, ArrayFrame
from taxeld_protocol.decoder import Scan

HELD_MAX = 256  # frames between two polls; beyond, the oldest are lost
SILENT_S = 1.0  # without a good frame for so long, a line says why
LINES_MAX = (
    20  # different lines that are logged, each of them once: a line a frame would hide all others
)

log = logging.getLogger(__name__)


class ArraySource(Source):
    """An array that somebody else sends."""

    is_busy = False  # the loop waits for the door
    comes_by_door = True

    def __init__(self, config: SourceConfig, layout: Layout, recorder: Recorder | None) -> None:
        self._decoder = ArrayDecoder(layout.uid.tolist(), config.array)
        super().__init__(Wire(self._decoder))
        self._endpoint = config.endpoint
        self._recorder = recorder
        self._held: deque[ArrayFrame] = deque(maxlen=HELD_MAX)
        self._good_s: float | None = None  # when a frame was used last
        self.look: Callable[[float], None] = lambda _: None  # at the door, where no loop does it
        self._said: set[str] = set()
        self._malformed, self._reason, self._connected = 0, "", False

    def hear(self, frame: ArrayFrame) -> None:
        self._held.append(frame)

    def heed(self, *, connected: bool, malformed: int, reason: str) -> None:
        if malformed != self._malformed:
            self._say(f"source.endpoint: messages are no arrays: {reason}")
        self._malformed, self._connected = malformed, connected
        self._reason = f" (the last was none: {reason})" if reason else ""

    def poll(self, now_s: float) -> list[Scan]:
        self.look(now_s)
        self._good_s = now_s if self._good_s is None else self._good_s
        self._decoder.now_t = time.time()
        scans: list[Scan] = []
        while self._held:
            frame = self._held.popleft()
            for heard in self.wire.take([frame]):
                scans += heard.scans
            if self._decoder.fault:
                self._say(self._decoder.fault)
            elif self._recorder is not None:
                self._recorder.take(frame)
        if scans:
            self._good_s, self.waits_for = now_s, ""
        elif now_s > self._good_s + SILENT_S:
            self.waits_for = self._decoder.fault or (
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
