"""Devices that a skin hangs on: a CAN interface of python-can's, or a serial line.

Neither reading nor writing waits. What has arrived comes out as frames or bytes, with its time. A
device that is lost raises LostError, whatever its driver raises.
"""

import contextlib
import logging
import time
from typing import Any

import can

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.bus_thread import BusThread
from taxeld.source.device import Device, LostError, Noticed
from taxeld.source.dialects import ToFrames
from taxeld.source.lines import SerialDevice
from taxeld.source.opening import first_line, unopened
from taxeld.source.outbox import Unit
from taxeld.source.slcan_device import SlcanDevice
from taxeld_protocol.frames import Frame

logging.getLogger("can").addHandler(logging.NullHandler())  # what goes wrong is said once, here

FRAMES_PER_POLL = 1000  # a flooded bus may not hold the loop; the rest waits for the next tick
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is of no Unix clock, but of the adapter's own


def open_device(config: SourceConfig, to_frames: ToFrames) -> Device:
    """The configured device, opened.

    Raises:
        AwayError: it is missing or busy.
        SetupError: it can never be opened so.
    """
    if config.kind == "can" and config.interface != "slcan":
        return CanDevice(config, to_frames)
    native = config.kind == "serial" and config.framing == "native"
    return (SerialDevice if native else SlcanDevice)(config, to_frames)


class CanDevice:
    """Any interface that python-can knows but SLCAN, which it reads byte by byte."""

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


def _open_bus(config: SourceConfig) -> Any:
    where = f"{config.interface} {config.channel}"
    try:
        return can.Bus(interface=config.interface, channel=config.channel, bitrate=config.bitrate)
    except (can.CanInterfaceNotImplementedError, ImportError) as error:
        raise SetupError(f"source.interface: {first_line(error)}") from None
    except Exception as error:  # each of python-can's interfaces raises its own
        raise unopened(where, error) from None
