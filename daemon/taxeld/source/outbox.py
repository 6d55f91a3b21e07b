"""Requests on their way to a device that may not take them at once. Nothing here waits."""

import contextlib
import time
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple, Protocol

from taxeld.source.bring_up import Request
from taxeld_protocol.frames import Frame

MOST = 128  # requests that wait; an iCub bus is asked by 14
PATIENCE_S = 0.5  # of a request: by then the bring-up has asked anew


class Unit(NamedTuple):
    """What a device takes at a time."""

    frame: Frame | None  # on a bus
    line: bytes = b""  # as a serial line carries it


class Taker(Protocol):
    """A device, as far as requests go."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        """A request, as the device takes it."""
        ...

    def put(self, unit: Unit) -> Unit | None:
        """Hand over a unit; → what was not taken of it.

        Raises:
            BlockingIOError: the device takes nothing now.
            LostError: the device is gone.
        """
        ...


class Outbox:
    """A bounded queue with a deadline for each request.

    A request of which a part went out is always finished: half a line or half a packet would spoil
    the next one.
    """

    def __init__(self, device: Taker) -> None:
        self.dropped = 0  # requests that were too old or too many, since last taken
        self._device = device
        self._waiting: deque[tuple[float, Request]] = deque()  # with the time that each may wait to
        self._begun: deque[Unit] = deque()

    def __bool__(self) -> bool:
        return bool(self._begun or self._waiting)

    def add(self, request: Request, now_s: float) -> None:
        """Queue a request; where too many wait, the oldest is dropped."""
        if len(self._waiting) >= MOST:
            self._drop()
        self._waiting.append((now_s + PATIENCE_S, request))

    def add_all(self, requests: Iterable[Request], now_s: float) -> None:
        """Queue some, in their order."""
        for request in requests:
            self.add(request, now_s)

    def clear(self) -> None:
        """Drop what has not begun."""
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
