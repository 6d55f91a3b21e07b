"""A virtual skin for the acceptance's tests: in memory, on the clock that it sleeps on."""

import io
import re
from collections.abc import Callable, Sequence

import numpy as np

from taxeld.arrays import Floats
from taxeld.source.device import Device
from taxeld_protocol import serial_link
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.modules import Module, wired
from taxeld_protocol.virtual_ihb import Answer, VirtualIhb
from tests.rig.virtual_hub import frames_of

LAYOUT = "cylinder:rows=2,columns=20,radius_m=0.06,pitch_m=0.015"  # four modules of ten taxels
MODULES = tuple(wired([i // 10 + 1 << 4 | i % 10 + 1 for i in range(40)]))
LEVEL, T0, NOISE = 10_000.0, 12_000.0, 34.0
PRESS_COUNTS = 9_000.0
SLOW = 10.0  # times the sleep that was asked for, as on a busy machine
PROMPT = re.compile(r"^\d+/\d+ press module (\d+) ")


class SleepClock:
    """Stands in for the module `time` where the code under test looks at it."""

    def __init__(self, now: float = 1_000_000.0) -> None:
        self.now = now

    def time(self) -> float:
        return self.now

    monotonic = time

    def sleep(self, seconds: float) -> None:
        self.now += SLOW * seconds

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


class VirtualSkin(Device):
    """A hub in memory and what it reads, as the device that the source opens."""

    def __init__(self, hub: VirtualIhb, counts: Counts, clock: SleepClock, *, native: bool) -> None:
        super().__init__()
        self.hub, self.counts, self.native = hub, counts, native
        self.wired_as: dict[int, int] = {}  # module that is asked for → that lies there
        self.operator = self.on_text  # reads what is printed
        self._clock, self._release_s = clock, np.inf
        self._waiting: list[Answer] = []

    def read(self) -> list[Frame | Chunk]:
        now, ihb = self._clock.now, self.hub.short_id
        if now >= self._release_s:
            self.counts.pressed = None
        if self.hub.due(now):
            self._waiting += self.hub.sensor_data(self.counts.scan())
        answers, self._waiting = self._waiting, []
        if self.native:
            return [Chunk(now, serial_link.encode(*answer, ihb=ihb)) for answer in answers]
        return [*frames_of(answers, ihb, now)]

    def send(self, to: int, command: int, payload: bytes) -> None:
        self._waiting += self.hub.answer(Packet(self._clock.now, to, command, payload))

    def close(self, wait_s: float = 0.0) -> None:
        """Nothing is held open."""

    def on_text(self, text: str) -> None:
        """The operator, who presses what is asked for: from what is printed."""
        if prompt := PROMPT.match(text):
            asked = int(prompt[1])
            self.counts.pressed = self.wired_as.get(asked, asked)
            self._release_s = self._clock.now + 0.4


class Operator(io.StringIO):
    """Standard output that someone reads."""

    def __init__(self, on_text: Callable[[str], None]) -> None:
        super().__init__()
        self._on_text = on_text

    def write(self, text: str) -> int:
        self._on_text(text)
        return super().write(text)
