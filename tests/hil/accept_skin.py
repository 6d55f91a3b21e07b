"""A virtual skin for the acceptance's tests: on a pseudo-terminal, on a clock of its own.

The clock is what the code under test sleeps on; a sleep serves the hub, and waits until the kernel
has its bytes on the other side. So seconds of scans take little time, on a busy machine as well.
"""

import io
import re
import select
import time
from collections.abc import Callable, Sequence

import numpy as np

from taxeld.arrays import Floats
from taxeld_protocol.modules import Module, wired
from tests.rig.virtual_hub import VirtualHub

LAYOUT = "cylinder:rows=2,columns=20,radius_m=0.06,pitch_m=0.015"  # four modules of ten taxels
MODULES = tuple(wired([i // 10 + 1 << 4 | i % 10 + 1 for i in range(40)]))
LEVEL, T0, NOISE = 10_000.0, 12_000.0, 34.0
PRESS_COUNTS = 9_000.0
WAIT_S = 5.0
SLOW = 10.0  # times the sleep that was asked for, as on a busy machine
PROMPT = re.compile(r"^\d+/\d+ press module (\d+) ")


class SleepClock:
    """Stands in for the module `time` where the code under test looks at it."""

    def __init__(self) -> None:
        self.now = 1_000_000.0
        self.on_sleep: Callable[[], None] = lambda: None

    def time(self) -> float:
        return self.now

    monotonic = time

    def sleep(self, seconds: float) -> None:
        self.now += SLOW * seconds
        self.on_sleep()

    def strftime(self, form: str) -> str:  # noqa: ARG002
        return "2026-01-01 00:00:00"


class Counts:
    """What the channels of some modules read; `pressed` makes touches."""

    def __init__(
        self,
        modules: Sequence[Module],
        noise: float | Floats = NOISE,
        fixed: dict[tuple[int, int], int] | None = None,
    ) -> None:
        """`fixed`: (SUI, name) → counts, whatever happens."""
        self.names = [(m.sui, name) for m in modules for name in m.names]
        self.noise = np.broadcast_to(noise, len(self.names))
        self.fixed = fixed or {}
        self.pressed: int | None = None  # SUI of the module under the finger
        self._rng = np.random.default_rng(0)

    def scan(self) -> list[int]:
        noise = self.noise * self._rng.standard_normal(len(self.names))
        values = []
        for (sui, name), off in zip(self.names, noise.tolist(), strict=True):
            press = PRESS_COUNTS * (0.4 + 0.06 * name) if name and sui == self.pressed else 0.0
            value = round((LEVEL if name else T0) + press + off)
            values.append(self.fixed.get((sui, name), value))
        return values


class VirtualSkin:
    """A hub and what it reads, served while the clock's owner sleeps."""

    def __init__(self, hub: VirtualHub, counts: Counts, clock: SleepClock) -> None:
        self.hub, self.counts = hub, counts
        self.wired_as: dict[int, int] = {}  # module that is asked for → that lies there
        self._clock = clock
        self.operator = self.on_text  # reads what is printed
        self._release_s = np.inf
        clock.on_sleep = self.serve

    def serve(self) -> None:
        hub, now = self.hub, self._clock.now
        if not hub.ihb.auto_sync:  # requests are under way: real time, a little
            select.select([hub.port], [], [], 0.001)
        hub.answer(now)
        if now >= self._release_s:
            self.counts.pressed = None
        if hub.ihb.due(now):
            before = hub.written
            hub.scan(self.counts.scan())
            self._wait_for_kernel(hub.written - before)

    def on_text(self, text: str) -> None:
        """The operator, who presses what is asked for: from what is printed."""
        if prompt := PROMPT.match(text):
            asked = int(prompt[1])
            self.counts.pressed = self.wired_as.get(asked, asked)
            self._release_s = self._clock.now + 0.4

    def was_stopped(self) -> bool:
        """Whether the last thing that the host asked for was that the scans stop."""
        hub = self.hub
        while hub.ihb.auto_sync and select.select([hub.port], [], [], WAIT_S)[0]:
            hub.answer(self._clock.now)
        return not hub.ihb.auto_sync

    def _wait_for_kernel(self, written: int) -> None:
        """Until a scan's last byte is on the reader's side of the pseudo-terminal."""
        deadline = time.monotonic() + WAIT_S
        while self.hub.port.waiting() < written and time.monotonic() < deadline:
            time.sleep(2e-5)


class Operator(io.StringIO):
    """Standard output that someone reads."""

    def __init__(self, on_text: Callable[[str], None]) -> None:
        super().__init__()
        self._on_text = on_text

    def write(self, text: str) -> int:
        self._on_text(text)
        return super().write(text)
