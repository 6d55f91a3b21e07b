"""A CAN interface of python-can's.

Neither reading nor writing waits. What has arrived comes out as frames, with their time. A bus that
is lost raises LostError, whatever its driver raises.
"""

import contextlib
import logging
import os
import queue
import threading
import time
from typing import Any

import can

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.device import LostError, Noticed
from taxeld.source.dialects import ToFrames
from taxeld.source.opening import first_line, unopened
from taxeld.source.outbox import Unit
from taxeld_protocol.frames import Frame

logging.getLogger("can").addHandler(logging.NullHandler())  # what goes wrong is said once, here

FRAMES_PER_POLL = 1000  # a flooded bus may not hold the loop; the rest waits for the next tick
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is of no Unix clock, but of the adapter's own
LISTEN_S = 0.1  # at a time
HELD = 1000  # messages; while they are not fetched, the rest waits in the driver


class CanDevice:
    """Any interface that python-can knows but SLCAN, which it reads byte by byte, and the kernel's,
    which it reads frame by frame."""

    waits_for = ""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        self.noticed = Noticed()
        self._to_frames = to_frames
        self._bus = _open_bus(config)
        self._thread: BusThread | None = None  # from the first `fileno` on, where the bus has none

    def fileno(self) -> int:
        if self._thread is not None:
            return self._thread.fileno()
        with contextlib.suppress(NotImplementedError, can.CanError):
            if (number := int(self._bus.fileno())) >= 0:
                return number
        self._thread = BusThread(self._bus)
        return self._thread.fileno()

    def read(self) -> list[Frame]:
        frames = []
        now = time.time()
        for _ in range(FRAMES_PER_POLL):
            try:
                message = self._next()
            except (can.CanError, OSError, ValueError, IndexError) as error:
                if not isinstance(error.__cause__ or error, (ValueError, IndexError)):
                    raise LostError from error
                self.noticed.noise += 1
                break
            if message is None:
                break
            if message.is_error_frame or message.is_remote_frame or message.is_fd:
                self.noticed.foreign += 1
                continue
            t = message.timestamp
            frames.append(
                Frame(
                    t if abs(t - now) < FOREIGN_CLOCK_S else now,
                    message.arbitration_id,
                    bytes(message.data),
                    message.is_extended_id,
                )
            )
        return frames

    def tend(self, now_s: float) -> None:
        """The kernel, or the driver, keeps it."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        return [Unit(frame) for frame in self._to_frames(command, payload)]

    def put(self, unit: Unit) -> None:
        assert unit.frame is not None  # noqa: S101  (as packed)
        message = can.Message(
            arbitration_id=unit.frame.can_id,
            data=unit.frame.data,
            is_extended_id=unit.frame.extended,
        )
        try:
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError) as error:  # full or down: reading tells when it is gone
            raise BlockingIOError from error

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        if self._thread is not None:
            self._thread.close()  # at once, where the bus has failed: its thread has ended
            self._thread = None
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _next(self) -> can.Message | None:
        if self._thread is not None:
            return self._thread.next()
        # not `recv`, which measures its time-out on the wall clock and waits for an hour where that
        # is set back by one
        message: can.Message | None = self._bus._recv_internal(0.0)[0]
        return message


class BusThread:
    """For a loop that cannot wait on a bus: what the bus brings, and a descriptor that is readable
    while there is some of it."""

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


def _open_bus(config: SourceConfig) -> Any:
    where = f"{config.interface} {config.channel}"
    try:
        return can.Bus(interface=config.interface, channel=config.channel, bitrate=config.bitrate)
    except (can.CanInterfaceNotImplementedError, ImportError) as error:
        raise SetupError(f"source.interface: {first_line(error)}") from None
    except Exception as error:  # each of python-can's interfaces raises its own
        raise unopened(where, error) from None
