"""The machine of a daemon on a fake clock: virtual skins, robots and a door, in this process.

Time passes while the daemon waits, sleeps or ends. Then all that is around it goes on, step by
step: the same rigs lead to the same run.
"""

import contextlib
import math
import select
import socket
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from queue import SimpleQueue
from typing import Any

from taxeld.config.tables import SourceConfig
from taxeld.door.settings import Settings
from taxeld.service.clock import Readable, Ready
from taxeld.service.realtime import RealTime
from taxeld.service.surroundings import Surroundings
from taxeld.source.device import AwayError, Device, LostError
from taxeld.stream import pair
from taxeld.stream.link import PeerLine, Report
from taxeld.stream.pair import Kind
from taxeld.worker import Job, Worker
from taxeld_hil.rig.faults import PoseRow
from taxeld_hil.rig.ledger import WireUnit
from taxeld_hil.rig.rig import Rig
from taxeld_protocol.cyskin import BROADCAST, Command, Packet
from taxeld_protocol.frames import Chunk, Frame

WORK_S = 0.00002  # of a pass of the loop, at least
START_STEPS = 3  # before scenario time 0, when the daemon is up
REPORT_S = 1.0
DESCRIPTOR = 1 << 20  # of a device: nobody waits on it but `Machine.wait`


class MemoryLine:
    """The wire between the rigs on it and the fake devices that are plugged into it, one after the
    other."""

    def __init__(self, *rigs: Rig) -> None:
        self.rigs, self.is_array = rigs, rigs[0].is_array
        self.t = 0.0  # scenario time [s]
        self.now = 0.0  # Unix time [s]
        self.has_host = True  # else nobody asks any more
        self._waiting: list[Any] = []  # frames, chunks or arrays

    @property
    def is_plugged(self) -> bool:
        return not any(rig.fails("unplugged", self.t) for rig in self.rigs)

    @property
    def is_readable(self) -> bool:
        return bool(self._waiting) or not self.is_plugged

    def send_due(self) -> None:
        """Deliver what the hubs send by themselves at this time."""
        for rig in self.rigs:
            self._deliver(rig, rig.scan(self.t, self.t))

    def send_rest(self) -> None:
        """Deliver what was held back, at the end."""
        for rig in self.rigs:
            self._deliver(rig, rig.rest())

    def ask(self, to: int, command: int, payload: bytes) -> None:
        """Deliver the answers to a request."""
        for rig in self.rigs if self.has_host else ():
            self._deliver(rig, rig.answer(Packet(self.now, to, command, payload), self.t))

    def take(self) -> list[Any]:
        """Frames, a chunk of bytes or arrays delivered since the last call."""
        came, self._waiting = self._waiting, []
        if came and self.rigs[0].line:
            return [Chunk(self.now, b"".join(chunk.data for chunk in came))]
        return came

    def _deliver(self, rig: Rig, units: list[WireUnit]) -> None:
        for unit in units:
            rig.ledger.deliver(unit, self.now)
            self._waiting.append(unit.at(self.now))  # a frame that was late arrives now


class MemoryDevice(Device):
    """The daemon's end of the wire."""

    def __init__(self, line: MemoryLine) -> None:
        """Raises AwayError where it is not plugged in."""
        super().__init__()
        self.line = line
        if not line.is_plugged:
            raise AwayError("source.channel: unplugged")
        line.take()  # as a serial port is flushed when it is opened

    def fileno(self) -> int:
        return DESCRIPTOR

    def read(self) -> Sequence[Frame | Chunk]:
        items = self.line.take()
        if not (items or self.line.is_plugged):
            raise LostError
        return items

    def send(self, to: int, command: int, payload: bytes) -> None:
        self.line.ask(to, command, payload)

    def close(self, wait_s: float = 0.0) -> None:
        """Nothing is held open."""


class MemoryDoor:
    """A door's process: it passes on what robot and array send, and hands over what is
    published."""

    pid = 0

    def __init__(self, machine: "Machine", end: socket.socket) -> None:
        self.machine, self._end = machine, end
        self.status: int | None = None  # None: it lives
        self._is_ready = self._owes_poses = False
        self._next_report_s = 0.0

    def poll(self) -> int | None:
        return self.status

    def wait(self, timeout: float) -> int:
        machine = self.machine
        self.listen()
        machine.advance(machine.now + timeout, lambda: self.status is not None)
        if self.status is None:
            raise subprocess.TimeoutExpired("door", timeout)
        return self.status

    def kill(self) -> None:
        self.end(-9)

    def step(self, poses: list[list[PoseRow]]) -> None:
        """A moment of its work; `poses`: what each link's robot sends."""
        if self.status is None:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                self.speak(poses)
            self.listen()

    def speak(self, poses: list[list[PoseRow]]) -> None:
        """Raises BlockingIOError, ConnectionError: the loop does not take it."""
        machine = self.machine
        if not self._is_ready:
            self._is_ready = True
            self.begin()
        if any(poses):
            self.say(Kind.POSES, poses, self._owes_poses, machine.unix())
            self._owes_poses = False
            for rig, rows in zip(machine.rigs, poses, strict=True):
                rig.ledger.poses_heard += len(rows)
        for line in machine.lines.values():
            for frame in line.take() if line.is_array else ():
                self.say(Kind.ARRAY, *frame)
        if machine.now >= self._next_report_s:
            self._next_report_s = machine.now + REPORT_S
            self.say(
                Kind.REPORT, asdict(Report(PeerLine(connected=True), PeerLine(connected=True)))
            )

    def begin(self) -> None:
        """Serve, and subscribe to arrays."""
        for line in self.machine.lines.values():
            if line.is_array:
                line.ask(BROADCAST, Command.SET_AUTO_SYNC, b"\1")
        self.say(Kind.READY)

    def listen(self) -> None:
        """Hear all that the loop has said."""
        while self.hear_next():
            pass

    def hear_next(self) -> bool:
        """Whether there was a packet."""
        packet = None
        if self.status is None:
            try:
                packet = pair.receive(self._end)
            except ConnectionResetError:  # what the loop has said before comes next
                return True
            except EOFError:
                self.end(0)
        if packet is not None:
            self.hear(*packet)
        return packet is not None

    def hear(self, kind: int, values: list[Any]) -> None:
        if kind == Kind.MESSAGE:
            topic, _, body = values
            self.machine.publish(topic, body)
        elif kind == Kind.ASK:
            (self._owes_poses,) = values
            if not self._owes_poses:
                with contextlib.suppress(BlockingIOError, ConnectionError):
                    self.say(Kind.POSES, [], True, self.machine.unix())

    def say(self, kind: Kind, *values: object) -> None:
        """Raises BlockingIOError: the loop is behind."""
        if not pair.send(self._end, kind, *values):
            raise BlockingIOError

    def end(self, status: int) -> None:
        if self.status is None:
            self.status = status
            self._end.close()


class SteppedWorker(Worker):
    """Works when the machine's time goes on, in the machine's thread."""

    def __init__(self, machine: "Machine", name: str, turn: Job, every_s: float) -> None:
        self._jobs, self._given, self._done = SimpleQueue(), 0, 0
        self._machine, self.name, self._turn, self._period_s = machine, name, turn, every_s
        self._next_s = machine.now + every_s

    def step(self) -> None:
        """Do what is to be done by now."""
        while self.behind and (job := self._jobs.get()):
            job()
            self._done += 1
        if self._machine.now >= self._next_s:
            self._next_s += self._period_s
            self._turn()

    def close(self, most_s: float) -> bool:
        machine = self._machine
        self._next_s = math.inf
        machine.advance(machine.now + most_s, lambda: not self.behind)
        return not self.behind


class Machine(Surroundings):
    """Time is scenario time, and Unix time is the same."""

    def __init__(
        self,
        lines: Mapping[str, MemoryLine],
        step_s: float,
        publish: Callable[[bytes, bytes], None] = lambda *_: None,
    ) -> None:
        """`lines` by what `SourceConfig.where` names; `publish` gets topics and bodies."""
        self.lines, self.publish = lines, publish
        self.rigs = [rig for line in lines.values() for rig in line.rigs]
        self.is_sending = True  # skin and robot
        self.doors: list[MemoryDoor] = []
        self.workers: list[SteppedWorker] = []
        self._steps, self._step_s = -START_STEPS, step_s
        self.now = self._steps * step_s  # monotonic [s]

    def advance(self, until_s: float, wakes: Callable[[], bool] = lambda: False) -> None:
        """Let time pass until then, or until `wakes`."""
        while self.now < until_s and not wakes():
            next_s = (self._steps + 1) * self._step_s
            self.now = min(until_s, next_s)
            if self.now >= next_s:
                self._steps += 1
                self.step()

    def step(self) -> None:
        """What is around the daemon goes on."""
        for line in self.lines.values():
            line.t, line.now = self.now, self.unix()
            if self.is_sending:
                line.send_due()
        poses = [self.poses(rig) for rig in self.rigs]
        for door in self.doors:
            door.step(poses)
        for worker in self.workers:
            if self.lets_work(worker):
                worker.step()

    def lets_work(self, _: SteppedWorker) -> bool:
        """Whether what the worker waits for does not hang."""
        return True

    def poses(self, rig: Rig) -> list[PoseRow]:
        """What a link's robot sends now."""
        return rig.poses(self.now, self.now, self.unix()) if self.is_sending else []

    def unix(self) -> float:
        return self.now

    def monotonic(self) -> float:
        return self.now

    def work_ns(self) -> int:
        return 0

    cpu_ns = work_ns

    def sleep(self, seconds: float) -> None:
        self.advance(self.now + seconds)

    def wait(
        self, devices: Sequence[Readable | None], door: Readable | None, until_s: float
    ) -> Ready:
        def ready() -> Ready:
            has_scan = any(isinstance(d, MemoryDevice) and d.line.is_readable for d in devices)
            return Ready(has_scan, door is not None and bool(select.select([door], [], [], 0)[0]))

        self.advance(self.now + WORK_S)
        for each in self.doors:
            each.listen()
        self.advance(until_s, lambda: any(ready()))
        return ready()

    def realtime(self, _: int) -> contextlib.AbstractContextManager[RealTime]:
        return contextlib.nullcontext(RealTime())

    def worker(self, name: str, turn: Job = lambda: None, every_s: float | None = None) -> Worker:
        self.workers.append(SteppedWorker(self, name, turn, every_s or math.inf))
        return self.workers[-1]

    def open_device(self, config: SourceConfig) -> Device:
        return MemoryDevice(self.lines[config.where])

    def start_door(self, _: Settings) -> tuple[MemoryDoor, socket.socket]:
        loops, doors = pair.open_pair()
        self.doors.append(MemoryDoor(self, doors))
        return self.doors[-1], loops
