"""A CAN interface of python-can. Neither reading nor writing waits.

SLCAN adapters and the kernel's interfaces have devices of their own, as python-can reads these byte
by byte and frame by frame.
"""

import contextlib
import logging
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

logging.getLogger("can").addHandler(logging.NullHandler())  # its faults are reported here, once

FRAMES_PER_POLL = 1000  # limit on a pass, so that a flooded bus cannot hold the loop
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is from the adapter's own clock


class CanDevice:
    """A bus of python-can. A bus without a descriptor is polled at each tick."""

    waits_for = ""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        """Raises SetupError where the bus cannot be opened."""
        self.noticed = Noticed()
        self._to_frames = to_frames
        self._bus = _open_bus(config)
        self._fault: Exception | None = None  # reported after the frames that came before it

    def fileno(self) -> int:
        with contextlib.suppress(NotImplementedError, can.CanError):
            return int(self._bus.fileno())
        return -1

    def read(self) -> list[Frame]:
        frames: list[Frame] = []
        now = time.time()
        for _ in range(FRAMES_PER_POLL):
            try:
                # `recv` measures its time-out on the wall clock, and waits for an hour where that
                # is set back by an hour
                message = self._bus._recv_internal(0.0)[0]
            except (can.CanError, OSError, ValueError, IndexError) as error:
                if isinstance(error.__cause__ or error, (ValueError, IndexError)):
                    self.noticed.noise += 1
                else:
                    self._fault = error
                break
            if message is None:
                break
            if message.is_error_frame or message.is_remote_frame or message.is_fd:
                self.noticed.foreign += 1
                continue
            t, data = message.timestamp, bytes(message.data)
            at = t if abs(t - now) < FOREIGN_CLOCK_S else now
            frames.append(Frame(at, message.arbitration_id, data, message.is_extended_id))
        if self._fault is not None and not frames:
            raise LostError from self._fault
        return frames

    def tend(self, now_s: float) -> None:
        """The driver keeps the bus."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        return [Unit(frame) for frame in self._to_frames(command, payload)]

    def put(self, unit: Unit) -> None:
        frame = unit.frame
        assert frame is not None  # noqa: S101  (as packed)
        message = can.Message(
            arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended
        )
        try:
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError) as error:  # full or down; reading finds a lost device
            raise BlockingIOError from error

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()


def _open_bus(config: SourceConfig) -> Any:
    where = f"{config.interface} {config.channel}"
    try:
        return can.Bus(interface=config.interface, channel=config.channel, bitrate=config.bitrate)
    except (can.CanInterfaceNotImplementedError, ImportError) as error:
        raise SetupError(f"source.interface: {first_line(error)}") from None
    except Exception as error:  # each of python-can's interfaces raises exceptions of its own
        raise unopened(where, error) from None
