"""What the loop sleeps on: the device, the robot, and the peers of the streams and of control."""

import contextlib
import select
import time
from collections.abc import Iterable
from typing import NamedTuple, Protocol

PEERS_S = 0.01  # those who come again and again are looked at so often
IN, ONCE = select.EPOLLIN, select.EPOLLIN | select.EPOLLONESHOT


class Readable(Protocol):
    """What has a descriptor; negative: none that can be waited on."""

    def fileno(self) -> int: ...


class Ready(NamedTuple):
    """Who may have something to say."""

    device: bool = False
    robot: bool = False
    peers: bool = False


NEVER_S = -1.0
ALL = Ready(device=True, robot=True, peers=True)


class Inputs:
    """One wait for all of them."""

    def __init__(self, peers: Iterable[int]) -> None:
        """`peers`: descriptors of the sockets that they come to."""
        self._epoll = select.epoll()
        self._device, self._robot = _Slot(self._epoll), _Slot(self._epoll)
        self._peers = tuple(peers)
        self._looked_s = NEVER_S  # when peers had come: so soon after that they do not wake it
        for number in self._peers:
            self._epoll.register(number, ONCE)

    def follow(self, device: Readable | None, robot: Readable | None) -> None:
        """Wait on these from now on; either may be another one each time, or none."""
        changed = [
            (slot, owner)
            for slot, owner in ((self._device, device), (self._robot, robot))
            if owner is not slot.owner
        ]
        for slot, _ in changed:  # first, as the number of one may have become the other's
            slot.leave()
        for slot, owner in changed:
            slot.enter(owner)

    def wait(self, until_s: float) -> Ready:
        """Sleep until something comes, but no longer; `until_s` is monotonic.

        Peers who come are looked at at once, and once more after PEERS_S, for what a look has left.
        """
        if self._looked_s > 0.0:
            until_s = min(until_s, self._looked_s + PEERS_S)
        # not its own time-out, which is of whole milliseconds
        left_s = max(0.0, until_s - time.monotonic())
        found = select.select((self._epoll,), (), (), left_s)[0]
        now_s = time.monotonic()
        again = 0.0 < self._looked_s <= now_s - PEERS_S
        if again:
            for number in self._peers:
                self._epoll.modify(number, ONCE)
        numbers = {number for number, _ in self._epoll.poll(0)} if found or again else set()
        come = not numbers.isdisjoint(self._peers)
        if come or again:
            self._looked_s = now_s if come else NEVER_S
        return Ready(self._device.number in numbers, self._robot.number in numbers, come or again)

    def rest(self, until_s: float) -> Ready:
        """The same, while the device may go on speaking: it is not listened to."""
        self._device.listen(0)
        try:
            return self.wait(until_s)
        finally:
            self._device.listen(IN)

    def close(self) -> None:
        self._epoll.close()


class _Slot:
    """A descriptor that may be another's one day."""

    def __init__(self, epoll: select.epoll) -> None:
        self.number = -1
        self.owner: Readable | None = None
        self._epoll = epoll

    def leave(self) -> None:
        if self.number >= 0:
            with contextlib.suppress(OSError):  # closed by now, and so no longer waited on
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
