"""The machine of a simulated daemon on which doors, disk, clock, skin and robot fail as drawn."""

import contextlib
import errno
import math
import os
import socket
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from taxeld.config.tables import SourceConfig
from taxeld.door.settings import Settings
from taxeld.source.device import AwayError, Device
from taxeld.stream import pair
from taxeld.stream.pair import Kind
from taxeld.stream.topics import TOPICS
from taxeld_hil.rig.faults import PoseRow
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.machine import Machine, MemoryDoor, MemoryLine, SteppedWorker
from taxeld_hil.scenario.scenario import Fault, Scenario

STEP_S = 0.005  # of the world
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


class World(Machine):
    """A skin whose robot may stand still; the faults are by scenario time."""

    def __init__(self, seed: int, faults: list[Drawn], moves: bool) -> None:
        hil = tuple(
            Fault(f.kind, f.at_s, f.for_s) for f in faults if f.kind in SKIN or f.kind in POSES
        )
        self.rig = Rig(Scenario("box", contacts=3, physics="scene", fault=hil), seed)
        self.rig.ledger.period_s = math.inf  # the daemon's clock is set, and it reads late
        super().__init__({"memory": MemoryLine(self.rig)}, STEP_S)
        self.faults, self.moves, self._stepped_s = faults, moves, 0.0
        self.rng = np.random.default_rng([seed, 8])
        self.taken: list[tuple[int, list[Any]]] = []  # packets, by the pairs
        self._done: set[Drawn] = set()
        calm_s = [f.at_s + f.for_s + (NO_DOOR_S if f.kind in NO_DOOR else CALM_S) for f in faults]
        self.end_s = max([self.rig.duration_s, *calm_s])

    def on(self, kind: str) -> bool:
        return any(f.kind == kind and f.at_s <= self.now < f.at_s + f.for_s for f in self.faults)

    def once(self, kind: str) -> Drawn | None:
        """A fault of a moment that has just come."""
        for fault in self.faults:
            if fault.kind == kind and fault.at_s <= self.now and fault not in self._done:
                self._done.add(fault)
                return fault
        return None

    def unix(self) -> float:
        return round(UNIX_S + self.now + self._stepped_s, 6)

    def step(self) -> None:
        if step := self.once("clock"):
            self._stepped_s += step.much
        super().step()

    def poses(self, rig: Rig) -> list[PoseRow]:
        """A recording keeps six digits of a second."""
        rows = super().poses(rig) if self.moves else []
        return [(round(t, 6), x, y, theta) for t, x, y, theta in rows]

    def lets_work(self, worker: SteppedWorker) -> bool:
        return worker.name == "doorkeeper" or not self.on("disk slow")

    def open_device(self, config: SourceConfig) -> Device:
        if self.on("no descriptor for the device"):
            raise AwayError("source.channel: cannot be opened (Too many open files)")
        return super().open_device(config)

    def start_door(self, _: Settings) -> tuple[MemoryDoor, socket.socket]:
        for kind in ("no descriptor for the pair", "door unstartable"):
            if self.on(kind):
                raise OSError(errno.EAGAIN, kind)
        loops, doors = pair.open_pair()
        self.doors.append(DrawnDoor(self, doors))
        return self.doors[-1], Tapped(loops, self.taken)

    def open_new(self, path: Path) -> FileIO:
        return File(path, self)


class File(FileIO):
    """On a disk that takes a part of what is written before it is full."""

    def __init__(self, path: Path, world: World) -> None:
        super().__init__(path, "x")
        self._world = world

    def write(self, data: Any) -> int:
        if self._world.on("disk error"):
            raise OSError(errno.EIO, "Input/output error")
        if self._world.on("disk full"):
            if len(data) < 3:
                raise OSError(errno.ENOSPC, "No space left on device")
            data = data[: len(data) // 2]
        return super().write(data)


class Tapped(socket.socket):
    """The loop's end of a pair, which notes the packets that it took."""

    def __init__(self, end: socket.socket, taken: list[tuple[int, list[Any]]]) -> None:
        super().__init__(fileno=end.detach())
        self.setblocking(False)
        self._taken = taken

    def send(self, data: Any, *flags: int) -> int:
        sent = super().send(data, *flags)
        kind, *values = msgpack.unpackb(data)
        self._taken.append((kind, values))
        return sent

    def sendmsg(self, buffers: Any, beside: Any, *more: Any) -> int:  # type: ignore[override]
        """A packet with a file."""
        sent = super().sendmsg(buffers, beside, *more)
        (file,) = beside[0][2]
        content = os.pread(file, os.fstat(file).st_size, 0)
        packet = msgpack.unpackb(buffers[0])
        kind, *values = msgpack.unpackb(content) if packet is None else [*packet, content]
        self._taken.append((kind, values))
        return sent


class DrawnDoor(MemoryDoor):
    """A door that may be slow, hang, be hostile, or die."""

    machine: World

    def __init__(self, world: World, end: socket.socket) -> None:
        super().__init__(world, end)
        self.got: list[tuple[int, list[Any]]] = []
        self._ready_s, self._next_read_s = world.now + READY_S, 0.0

    def step(self, poses: list[list[PoseRow]]) -> None:
        if self.status is None and self.machine.once("door killed"):
            self.end(int(self.machine.rng.choice([-9, -6, -11, 1])))
        if not self._hangs:
            super().step(poses)

    @property
    def _hangs(self) -> bool:
        return self.machine.on("door hangs") or self.machine.now < self._ready_s

    def begin(self) -> None:
        if self.machine.on("door refuses"):
            self.say(Kind.FAULT, "publish.endpoints: cannot bind")
            self.end(2)
            raise ConnectionAbortedError
        self.say(Kind.WANTED, list(TOPICS[:5]))
        super().begin()

    def speak(self, poses: list[list[PoseRow]]) -> None:
        super().speak(poses)
        for name in ("reset", "tare"):
            if self.machine.once(name):
                self.say(Kind.CHANGE, 1, name, {})
        for _ in range(400 * self.machine.on("door floods")):
            self.say(Kind.POSES, [[]], False, self.machine.unix())

    def listen(self) -> None:
        is_slow, now = self.machine.on("door slow"), self.machine.now
        if not (self._hangs or (is_slow and now < self._next_read_s)):
            self._next_read_s = now + SLOW_S
            if not is_slow:
                super().listen()
            else:
                self.hear_next()

    def hear(self, kind: int, values: list[Any]) -> None:
        self.got.append((kind, values))
        super().hear(kind, values)

    def end(self, status: int) -> None:
        """It dies with what it has not read."""
        with contextlib.suppress(EOFError, ConnectionError):
            while self.status is None and (packet := pair.receive(self._end)) is not None:
                self.got.append(packet)
        super().end(status)
