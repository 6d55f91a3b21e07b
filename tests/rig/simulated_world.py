"""The world of a simulated daemon: clocks, a skin on its robot, disk and door, and what fails when.

The door's end of the pair is real, its process is not.
"""

import contextlib
import errno
import math
import os
import select
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from taxeld.errors import SetupError
from taxeld.service.clock import Ready
from taxeld.source.device import AwayError, LostError
from taxeld.stream import pair
from taxeld.stream.link import Report
from taxeld.stream.pair import Kind
from taxeld.stream.topics import TOPICS
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.fake import MemoryDevice, MemoryLine
from taxeld_hil.scenario.scenario import Fault, Scenario
from tests.rig.fake_threads import Threads

STEP_S, WORK_S = 0.005, 0.00002  # of the world, and of a pass of the loop at least
READY_S, SLOW_S = 0.15, 0.1  # until a door is ready, and between packets that a slow one reads
CALM_S, NO_DOOR_S = 3.0, 6.5  # after the last fault, and after one of a door's start
UNIX_S = 1_700_000_000.0
DOOR = ("door killed", "door hangs", "door slow", "door floods")
NO_DOOR = ("door refuses", "door unstartable", "no descriptor for the pair")
DISK = ("disk full", "disk error", "disk slow")
SKIN = ("unplugged", "reboot", "dropped", "corrupted", "duplicated", "late")
POSES = ("pose_silent", "pose_late", "pose_jumping")
OTHER = ("clock", "no descriptor for the device", "reset", "tare")


@dataclass(frozen=True)
class Drawn:
    """What goes wrong, from when to when, by scenario time; `much`: seconds of a clock's step."""

    kind: str
    at_s: float
    for_s: float
    much: float = 0.0


def draw(seed: int) -> tuple[list[Drawn], bool]:
    """The faults of a run, and whether a robot moves the sensor."""
    rng = np.random.default_rng([seed, 7])
    kinds = (*DOOR, *NO_DOOR, *DISK)
    if seed % 3:
        kinds += (*SKIN, *POSES, *OTHER)
    found = []
    for kind in rng.choice(kinds, size=rng.integers(1, 6)):
        at_s, for_s = rng.uniform(1.0, 8.0), 10 ** rng.uniform(-1.3, 0.85)
        much = float(rng.choice([-1.0, 1.0]) * 10 ** rng.uniform(-0.5, 5.0))
        found.append(Drawn(str(kind), round(at_s, 3), round(for_s, 3), round(much, 3)))
        if kind in NO_DOOR:  # is met by a door that is started
            found.append(Drawn("door killed", round(at_s + 0.01, 3), 0.0))
        if kind == "no descriptor for the device":
            found.append(Drawn("unplugged", round(at_s - 0.2, 3), 0.3))
    return found, bool(rng.random() < 0.6)


class World:
    """Clocks, skin, robot, door and disk."""

    def __init__(self, seed: int, faults: list[Drawn], moves: bool) -> None:
        hil = tuple(
            Fault(f.kind, f.at_s, f.for_s) for f in faults if f.kind in SKIN or f.kind in POSES
        )
        scenario = Scenario("box", contacts=3, physics="scene", fault=hil)
        self.rig, self.faults, self.moves = Rig(scenario, seed), faults, moves
        self.rig.ledger.period_s = math.inf  # the daemon's clock is set, and it reads late
        self.line = Line(self)
        self.now, self._next_s, self._stepped_s = 100.0, 100.0, 0.0
        self.start_s = self.now
        self.threads = Threads(lambda: self.now, self.advance)
        self.writers = Threads(lambda: self.now, self.advance)
        self.rng = np.random.default_rng([seed, 8])
        self.doors: list[SimulatedDoor] = []
        self._done: set[Drawn] = set()
        calm_s = [f.at_s + f.for_s + (NO_DOOR_S if f.kind in NO_DOOR else CALM_S) for f in faults]
        self.end_s = max([self.rig.duration_s, *calm_s])

    @property
    def t(self) -> float:
        """Scenario time."""
        return self.now - self.start_s

    def unix(self) -> float:
        return round(UNIX_S + self.now + self._stepped_s, 6)

    def on(self, kind: str) -> bool:
        return any(f.kind == kind and f.at_s <= self.t < f.at_s + f.for_s for f in self.faults)

    def once(self, kind: str) -> Drawn | None:
        """A fault of a moment that has just come."""
        for fault in self.faults:
            if fault.kind == kind and fault.at_s <= self.t and fault not in self._done:
                self._done.add(fault)
                return fault
        return None

    def advance(self, until_s: float, wakes: Callable[[], bool] = lambda: False) -> None:
        """Let time pass until then, or until `wakes`."""
        while self.now < until_s and not wakes():
            self.now = min(until_s, self._next_s)
            if self.now >= self._next_s:
                self._next_s += STEP_S
                self._step()

    def _step(self) -> None:
        if step := self.once("clock"):
            self._stepped_s += step.much
        self.line.t, self.line.now = self.t, self.now
        if self.t < self.end_s:
            self.line.send_due()
        # a recording keeps six digits of a second
        poses = [(round(t, 6), *pose) for t, *pose in self.rig.poses(self.t, self.now, self.unix())]
        for door in self.doors:
            door.step(poses if self.moves else [])
        self.threads.take_turns()
        if not self.on("disk slow"):
            self.writers.take_turns()

    def write(self, write: Callable[[Any], int], data: Any) -> int:
        """To the disk, of which a part is taken before it is full."""
        if self.on("disk error"):
            raise OSError(errno.EIO, "Input/output error")
        if self.on("disk full"):
            if len(data) < 3:
                raise OSError(errno.ENOSPC, "No space left on device")
            return write(data[: len(data) // 2])
        return write(data)


class Line(MemoryLine):
    """The wire; what comes is stamped with Unix time."""

    def __init__(self, world: World) -> None:
        super().__init__(world.rig)
        self._world = world

    def _deliver(self, rig: Rig, units: list[Any]) -> None:
        now, self.now = self.now, self._world.unix()
        super()._deliver(rig, units)
        self.now = now

    @property
    def is_readable(self) -> bool:
        return bool(self._waiting) or not self.is_plugged


class SimulatedDevice(MemoryDevice):
    """The daemon's end of the wire."""

    def __init__(self, world: World) -> None:
        if world.on("no descriptor for the device"):
            raise AwayError("source.channel: cannot be opened (Too many open files)")
        try:
            super().__init__(world.line)
        except SetupError as error:
            raise AwayError(str(error)) from None

    @staticmethod
    def fileno() -> int:
        return 1 << 20  # which nobody waits on but `simulated_wait`

    def read(self) -> Any:
        if items := self._line.take():
            return items
        if not self._line.is_plugged:
            raise LostError
        return items


def simulated_wait(world: World, devices: Sequence[Any], door: Any, until_s: float) -> Ready:
    """`clock.wait` on the fake clock, with one link."""
    device = devices[0] if devices else None

    def ready() -> Ready:
        has_pose = door is not None and bool(select.select([door], [], [], 0)[0])
        return Ready(device is not None and world.line.is_readable, has_pose)

    world.advance(world.now + WORK_S)
    world.advance(until_s, lambda: any(ready()))
    return ready()


class SimulatedDoor:
    """In place of `subprocess.Popen`: a door that may be slow, hang, be hostile, or die."""

    pid = 2**30  # of no process

    def __init__(self, world: World, _: object, *, pass_fds: list[int], **__: object) -> None:
        if world.on("door unstartable"):
            raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
        self._world, self._end = world, pair.socket.socket(fileno=os.dup(pass_fds[0]))
        self._end.setblocking(False)
        self.got: list[tuple[int, list[Any]]] = []
        self._status: int | None = None
        self._ready_s = world.now + READY_S
        self._is_ready = False
        self._next_report_s = self._next_read_s = 0.0
        world.doors.append(self)

    def wait(self) -> int:
        self._world.threads.park(lambda: self._status is not None)
        assert self._status is not None
        return self._status

    def kill(self) -> None:
        self._die(-9)

    def step(self, poses: list[Any]) -> None:
        world = self._world
        if self._status is None and world.once("door killed"):
            self._die(int(world.rng.choice([-9, -6, -11, 1])))
        if self._status is not None or world.on("door hangs") or world.now < self._ready_s:
            return
        with contextlib.suppress(BlockingIOError, ConnectionError):
            self._speak(poses)
        self._listen()

    def _speak(self, poses: list[Any]) -> None:
        world = self._world
        if not self._is_ready:
            self._is_ready = True
            if world.on("door refuses"):
                self._say(Kind.FAULT, "publish.endpoints: cannot bind")
                self._die(2)
                return
            self._say(Kind.WANTED, list(TOPICS[:5]))
            self._say(Kind.READY)
        for pose in poses:
            self._say(Kind.POSES, [[pose]], False, world.unix())
        for name in ("reset", "tare"):
            if world.once(name):
                self._say(Kind.CHANGE, 1, name, {})
        if world.now >= self._next_report_s:
            self._next_report_s = world.now + 1.0
            self._say(Kind.REPORT, asdict(Report()))
        for _ in range(400 * world.on("door floods")):
            self._say(Kind.POSES, [[]], False, world.unix())

    def _listen(self) -> None:
        slow = self._world.on("door slow")
        if self._status is not None or (slow and self._world.now < self._next_read_s):
            return
        self._next_read_s = self._world.now + SLOW_S
        try:
            while (packet := pair.receive(self._end)) is not None:
                self.got.append(packet)
                if packet[0] == Kind.ASK:
                    self._say(Kind.POSES, [[]], True, self._world.unix())
                if slow:
                    return
        except (EOFError, ConnectionError):
            self._die(0)

    def _say(self, kind: Kind, *values: object) -> None:
        if not pair.send(self._end, kind, *values):
            raise BlockingIOError

    def _die(self, status: int) -> None:
        if self._status is not None:
            return
        with contextlib.suppress(EOFError, ConnectionError):  # it dies with what it has not read
            while (packet := pair.receive(self._end)) is not None:
                self.got.append(packet)
        self._end.close()
        self._status = status
