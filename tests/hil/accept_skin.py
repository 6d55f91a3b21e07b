"""A virtual skin for the acceptance's tests: on a pseudo-terminal, on a clock of its own.

The clock is what the code under test sleeps on; a sleep serves the hub, and waits until the kernel
has carried its bytes over. So seconds of scans take little time, and no load can spoil them.
"""

import fcntl
import io
import os
import re
import select
import struct
import termios
import time
import tty
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np

from taxeld_hil.adapter import SlcanAdapter
from taxeld_protocol import cyskin, serial_link, slcan
from taxeld_protocol.modules import Module, wired
from taxeld_protocol.serial_link import SerialReader
from taxeld_protocol.virtual_ihb import VirtualIhb

LAYOUT = "cylinder:rows=2,columns=20,radius_m=0.06,pitch_m=0.015"  # four modules of ten taxels
MODULES = tuple(wired([i // 10 + 1 << 4 | i % 10 + 1 for i in range(40)]))
LEVEL, T0, NOISE = 10_000.0, 12_000.0, 34.0
PRESS_COUNTS = 9_000.0
CARRY_S = 5.0
SLOW = 10.0  # times the sleep that was asked for, as on a busy machine
PROMPT = re.compile(r"^\d+/\d+ press module (\d+) ")


class Clock:
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
    """What the channels of some modules read; `fixed` and `pressed` make faults and touches."""

    def __init__(self, modules: Sequence[Module], seed: int = 0, noise: float = NOISE) -> None:
        self.names = [(m.sui, name) for m in modules for name in m.names]
        self.noise = np.full(len(self.names), noise)
        self.fixed: dict[tuple[int, int], int] = {}  # (SUI, name) → counts
        self.pressed: int | None = None  # SUI of the module under the finger
        self._rng = np.random.default_rng(seed)

    def scan(self) -> list[int]:
        rng = self._rng
        values = []
        for (sui, name), noise in zip(self.names, self.noise, strict=True):
            base = T0 if name == 0 else LEVEL
            press = PRESS_COUNTS * (0.4 + 0.06 * name) if name and sui == self.pressed else 0.0
            value = base + press + noise * rng.standard_normal()
            values.append(self.fixed.get((sui, name), round(value)))
        return values


class BusAdapter(SlcanAdapter):
    """Counts what it writes, and turns a bit of every n-th packet of counts."""

    written = 0
    damage_every = 0
    _packets = 0

    def send(self, command: int, payload: bytes, t: float) -> None:
        if command != cyskin.Command.SENSOR_DATA:
            super().send(command, payload, t)
            return
        self._packets += 1
        damaged = self.damage_every and self._packets % self.damage_every == 0
        for i, frame in enumerate(cyskin.to_frames(command, payload, ihb=self.ihb.short_id, t=t)):
            flip = bytes((frame.data[0] ^ 0x10,)) + frame.data[1:]
            self._write(slcan.encode(frame._replace(data=flip) if damaged and i == 1 else frame))

    def _write(self, data: bytes) -> None:
        self.written += len(data)
        super()._write(data)


class NativeAdapter:
    """A hub on the native serial link, as `SlcanAdapter` is one behind SLCAN."""

    def __init__(self, ihb: VirtualIhb) -> None:
        self.ihb = ihb
        self.written = 0
        self._requests = SerialReader()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)

    def fileno(self) -> int:
        return self._master

    def serve(self, t: float) -> None:
        try:
            data = os.read(self._master, 4096)
        except OSError:  # nothing there
            return
        for packet in self._requests.feed(data, t):
            for command, payload in self.ihb.answer(packet):
                self.send(command, payload, t)

    def send(self, command: int, payload: bytes, t: float) -> None:  # noqa: ARG002
        self.written += os.write(
            self._master, serial_link.encode(command, payload, ihb=self.ihb.short_id)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._master)
        os.close(self._slave)


class VirtualSkin:
    """A hub behind an adapter, served while the clock's owner sleeps."""

    def __init__(self, adapter: Any, counts: Counts, clock: Clock) -> None:
        self.adapter, self.counts = adapter, counts
        self.period_ms: int | None = None  # what it keeps to, whatever it is asked for
        self.wired_as: dict[int, int] = {}  # module that is asked for → that lies there
        self._clock = clock
        self.operator = self.on_text  # hears what is printed
        self._release_s = np.inf
        clock.on_sleep = self.serve

    def serve(self) -> None:
        adapter, now = self.adapter, self._clock.now
        if not adapter.ihb.auto_sync:  # requests are under way: real time, a little
            select.select([adapter], [], [], 0.001)
        adapter.serve(now)
        if now >= self._release_s:
            self.counts.pressed = None
        if self.period_ms:
            adapter.ihb.period_ms = self.period_ms
        if adapter.ihb.due(now):
            before = adapter.written
            for command, payload in adapter.ihb.sensor_data(self.counts.scan()):
                adapter.send(command, payload, now)
            self._carry(adapter.written - before)

    def on_text(self, text: str) -> None:
        """The operator, who presses what is asked for: from what is printed."""
        if prompt := PROMPT.match(text):
            asked = int(prompt[1])
            self.counts.pressed = self.wired_as.get(asked, asked)
            self._release_s = self._clock.now + 0.4

    def was_stopped(self) -> bool:
        """Whether the host switched the scans off, in its last words."""
        while self.adapter.ihb.auto_sync and select.select([self.adapter], [], [], CARRY_S)[0]:
            self.adapter.serve(self._clock.now)
        return not self.adapter.ihb.auto_sync

    def _carry(self, written: int) -> None:
        """Wait until the kernel has carried a scan's last byte to the reader's side."""
        deadline = time.monotonic() + CARRY_S
        while self._waiting() < written and time.monotonic() < deadline:
            time.sleep(2e-5)

    def _waiting(self) -> int:
        found = fcntl.ioctl(self.adapter._slave, termios.FIONREAD, b"\0" * 4)
        return int(struct.unpack("i", found)[0])


class Operator(io.StringIO):
    """Standard output that someone reads."""

    def __init__(self, on_text: Callable[[str], None]) -> None:
        super().__init__()
        self._on_text = on_text

    def write(self, text: str) -> int:
        self._on_text(text)
        return super().write(text)
