"""A thread that waits on a bus of python-can's for a loop that cannot: where the bus has no
descriptor, this one has."""

import contextlib
import os
import queue
import threading
from typing import Any

import can

LISTEN_S = 0.1  # at a time
HELD = 1000  # messages; while they are not fetched, the rest waits in the driver


class BusThread:
    """What a bus brings, and a descriptor that is readable while there is some of it."""

    def __init__(self, bus: Any) -> None:
        self._bus = bus
        self._held: queue.Queue[can.Message | Exception] = queue.Queue(HELD)
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bus", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        return self._event

    def next(self) -> can.Message | None:
        """The next message, without waiting; raises what the bus has raised."""
        held = self._taken()
        if held is None:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._event)
            held = self._taken()  # what is held from here on makes it readable again
        if isinstance(held, Exception):
            raise held
        return held

    def close(self) -> None:
        """To be called before the bus is shut down."""
        self._closed.set()
        self._thread.join(2.0 * LISTEN_S)
        if not self._thread.is_alive():
            os.close(self._event)

    def _taken(self) -> can.Message | Exception | None:
        try:
            return self._held.get_nowait()
        except queue.Empty:
            return None

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                heard, _ = self._bus._recv_internal(LISTEN_S)
            except Exception as error:  # the loop knows what to do with it
                heard = error
            if heard is not None:
                self._hold(heard)
            if isinstance(heard, Exception) and not isinstance(heard, (ValueError, IndexError)):
                return

    def _hold(self, heard: can.Message | Exception) -> None:
        while not self._closed.is_set():
            with contextlib.suppress(queue.Full):
                self._held.put(heard, timeout=LISTEN_S)
                os.eventfd_write(self._event, 1)
                return
