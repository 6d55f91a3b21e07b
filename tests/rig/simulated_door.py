"""The door of a simulated daemon: its end of the pair is real, its process is not."""

import contextlib
import errno
import os
from dataclasses import asdict
from typing import Any

from taxeld.stream import pair
from taxeld.stream.link import Report
from taxeld.stream.pair import Kind
from taxeld.stream.topics import TOPICS
from tests.rig.simulated_world import World

START_S, SLOW_S = 0.15, 0.1  # until it is ready, and between packets that a slow one reads


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
        self._ready_s = world.now + START_S
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
            self._say(Kind.POSES, [[pose]], False)
        for name in ("reset", "tare"):
            if world.once(name):
                self._say(Kind.CHANGE, 1, name, {})
        if world.now >= self._next_report_s:
            self._next_report_s = world.now + 1.0
            self._say(Kind.REPORT, asdict(Report()))
        for _ in range(400 * world.on("door floods")):
            self._say(Kind.POSES, [[]], False)

    def _listen(self) -> None:
        slow = self._world.on("door slow")
        if self._status is not None or (slow and self._world.now < self._next_read_s):
            return
        self._next_read_s = self._world.now + SLOW_S
        try:
            while (packet := pair.receive(self._end)) is not None:
                self.got.append(packet)
                if packet[0] == Kind.ASK:
                    self._say(Kind.POSES, [[]], True)
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
