"""A CAN interface of python-can.

SLCAN adapters and the kernel's interfaces have devices of their own, as python-can reads these byte
by byte and frame by frame.
"""

import contextlib
import logging
from typing import Any

import can

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.device import BusDevice, first_line, unopened
from taxeld.source.dialects import ToFrames
from taxeld_protocol.frames import Frame

logging.getLogger("can").addHandler(logging.NullHandler())  # its faults are reported here, once


class CanDevice(BusDevice):
    """A bus of python-can. A bus without a descriptor is polled at each tick."""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        """Raises SetupError where the bus cannot be opened."""
        super().__init__(to_frames)
        self._bus = _open_bus(config)

    def fileno(self) -> int:
        with contextlib.suppress(NotImplementedError, can.CanError):
            return int(self._bus.fileno())
        return -1

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _receive(self) -> Frame | None:
        try:
            # `recv` measures its time-out on the wall clock, and waits for an hour where that is
            # set back by an hour
            message = self._bus._recv_internal(0.0)[0]
        except (can.CanError, OSError, ValueError, IndexError) as error:
            is_noise = isinstance(error.__cause__ or error, (ValueError, IndexError))
            raise (ValueError if is_noise else ConnectionError)(str(error)) from None
        if message is None:
            raise BlockingIOError
        if message.is_error_frame or message.is_remote_frame or message.is_fd:
            return None
        number, data = message.arbitration_id, bytes(message.data)
        return Frame(message.timestamp, number, data, message.is_extended_id)

    def _send(self, frame: Frame) -> None:
        message = can.Message(
            arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended
        )
        try:
            self._bus.send(message, timeout=0.0)
        except can.CanError as error:
            raise BlockingIOError from error


def _open_bus(config: SourceConfig) -> Any:
    where = f"{config.interface} {config.channel}"
    try:
        return can.Bus(interface=config.interface, channel=config.channel, bitrate=config.bitrate)
    except (can.CanInterfaceNotImplementedError, ImportError) as error:
        raise SetupError(f"source.interface: {first_line(error)}") from None
    except Exception as error:  # each of python-can's interfaces raises exceptions of its own
        raise unopened(where, error) from None
