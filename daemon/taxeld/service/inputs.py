"""The inputs that the loop sleeps on: the device and, while a scan waits for a pose, the door."""

import contextlib
import select
import time
from typing import NamedTuple, Protocol

IN = select.EPOLLIN


class Readable(Protocol):
    """An object with a descriptor; a negative one cannot be waited on."""

    def fileno(self) -> int: ...


class Ready(NamedTuple):
    """The inputs that may have arrivals."""

    device: bool = False
    robot: bool = False


ALL = Ready(device=True, robot=True)


class Inputs:
    """One wait for both inputs."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._device, self._robot = _Slot(self._epoll), _Slot(self._epoll)

    def follow(self, device: Readable | None, robot: Readable | None) -> None:
        """Wait on these from now on; each may be another one every time, or none."""
        changed = [
            (slot, owner)
            for slot, owner in ((self._device, device), (self._robot, robot))
            if owner is not slot.owner
        ]
        for slot, _ in changed:  # all leave first, as one's old number may be the other's new one
            slot.leave()
        for slot, owner in changed:
            slot.enter(owner)

    def wait(self, until_s: float) -> Ready:
        """Sleep until an input is ready, at most until the monotonic time `until_s`."""
        # epoll's own time-out has only whole milliseconds
        left_s = max(0.0, until_s - time.monotonic())
        found = select.select((self._epoll,), (), (), left_s)[0]
        numbers = {number for number, _ in self._epoll.poll(0)} if found else set()
        return Ready(self._device.number in numbers, self._robot.number in numbers)

    def rest(self, until_s: float) -> Ready:
        """The same without waiting on the device, which may go on sending."""
        self._device.listen(0)
        try:
            return self.wait(until_s)
        finally:
            self._device.listen(IN)

    def close(self) -> None:
        self._epoll.close()


class _Slot:
    """A place for a descriptor, whose number may later belong to another object."""

    def __init__(self, epoll: select.epoll) -> None:
        self.number = -1
        self.owner: Readable | None = None
        self._epoll = epoll

    def leave(self) -> None:
        if self.number >= 0:
            with contextlib.suppress(OSError):  # already closed, and so no longer waited on
                self._epoll.unregister(self.number)
        self.owner, self.number = None, -1

    def enter(self, owner: Readable | None) -> None:
        self.owner = owner
        self.number = -1 if owner is None else owner.fileno()
        if self.number >= 0:
            self._epoll.register(self.number, IN)

    def listen(self, events: int) -> None:
        if self.number >= 0:
            self._epoll.modify(self.number, events)
