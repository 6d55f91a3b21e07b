"""Requests on their way to a device that may not take them at once."""

import contextlib
import time
from collections import deque
from collections.abc import Iterable

from taxeld.source.bring_up import Request
from taxeld.source.device import Device, Piece
from taxeld_protocol.frames import Frame

MOST = 128  # requests that wait; a bring-up has a few at a time
PATIENCE_S = 0.5  # a request that waited longer is dropped: the bring-up asks again


class Outbox:
    """A bounded queue with a deadline for each request.

    A request that is partly sent is always finished: half a packet would spoil the next one.
    """

    def __init__(self, device: Device) -> None:
        self.dropped = 0  # requests that were too old or too many; its reader sets it to 0
        self._device = device
        self._waiting: deque[tuple[float, Request]] = deque()  # (deadline, request)
        self._begun: deque[Piece] = deque()  # pieces of the request that is being sent

    def __bool__(self) -> bool:
        return bool(self._begun or self._waiting)

    def add(self, requests: Iterable[Request], now_s: float) -> None:
        """Queue requests in their order; where too many wait, the oldest is dropped."""
        for request in requests:
            if len(self._waiting) >= MOST:
                self._drop()
            self._waiting.append((now_s + PATIENCE_S, request))

    def clear(self) -> None:
        """Drop all requests but one that is partly sent."""
        while self._waiting:
            self._drop()

    def flush(self, now_s: float) -> list[Frame]:
        """Send what the device takes; → the frames that went out on a bus.

        Raises:
            LostError: the device is gone.
        """
        while self._waiting and self._waiting[0][0] < now_s:
            self._drop()
        sent: list[Frame] = []
        with contextlib.suppress(BlockingIOError):
            while self._next():
                piece = self._begun[0]
                self._device.put(piece)
                self._begun.popleft()
                if isinstance(piece, Frame):
                    sent.append(piece._replace(t=time.time()))
        return sent

    def _drop(self) -> None:
        self._waiting.popleft()
        self.dropped += 1

    def _next(self) -> bool:
        while not self._begun and self._waiting:
            _, request = self._waiting.popleft()
            self._begun.extend(self._device.pack(*request))
        return bool(self._begun)
