"""Requests on their way to a device that may not take them at once. Nothing here waits."""

import contextlib
import time
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple, Protocol

from taxeld.source.bring_up import Request
from taxeld_protocol.frames import Frame

MOST = 128  # requests that wait; an iCub bring-up sends 14 at a time
PATIENCE_S = 0.5  # a request that waited longer is dropped: the bring-up asks again


class Unit(NamedTuple):
    """A part of a request that a device takes at once: a frame, or bytes of a serial line."""

    frame: Frame | None  # None on a serial line
    line: bytes = b""  # empty on a bus


class Taker(Protocol):
    """The part of a device that takes requests."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        """A request as the units of this device."""
        ...

    def put(self, unit: Unit) -> Unit | None:
        """Hand over a unit; → the rest of it that was not taken, None if all was.

        Raises:
            BlockingIOError: the device takes nothing now.
            LostError: the device is gone.
        """
        ...


class Outbox:
    """A bounded queue with a deadline for each request.

    A request that is partly sent is always finished: half a line or half a packet would spoil the
    next one.
    """

    def __init__(self, device: Taker) -> None:
        self.dropped = 0  # requests that were too old or too many; its reader sets it to 0
        self._device = device
        self._waiting: deque[tuple[float, Request]] = deque()  # (deadline, request)
        self._begun: deque[Unit] = deque()  # units of a request that is partly sent

    def __bool__(self) -> bool:
        return bool(self._begun or self._waiting)

    def add(self, request: Request, now_s: float) -> None:
        """Queue a request; where too many wait, the oldest is dropped."""
        if len(self._waiting) >= MOST:
            self._drop()
        self._waiting.append((now_s + PATIENCE_S, request))

    def add_all(self, requests: Iterable[Request], now_s: float) -> None:
        """Queue several requests in their order."""
        for request in requests:
            self.add(request, now_s)

    def clear(self) -> None:
        """Drop all requests but one that is partly sent."""
        while self._waiting:
            self._drop()

    def flush(self, now_s: float) -> list[Frame]:
        """Hand over what the device takes; → the frames that went out on a bus.

        Raises:
            LostError: the device is gone.
        """
        while self._waiting and self._waiting[0][0] < now_s:
            self._drop()
        sent: list[Frame] = []
        with contextlib.suppress(BlockingIOError):
            while self._next():
                unit = self._begun[0]
                rest = self._device.put(unit)
                if rest is not None:
                    self._begun[0] = rest
                    continue
                self._begun.popleft()
                if unit.frame is not None:
                    sent.append(unit.frame._replace(t=time.time()))
        return sent

    def _drop(self) -> None:
        self._waiting.popleft()
        self.dropped += 1

    def _next(self) -> bool:
        """Whether there is a unit to hand over."""
        while not self._begun and self._waiting:
            _, request = self._waiting.popleft()
            self._begun.extend(self._device.pack(*request))
        return bool(self._begun)
