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
from taxeld.source.bus_faults import kinds
from taxeld.source.device import BusDevice, first_line, unopened
from taxeld_protocol.frames import Frame

INTERFACES = sorted(can.VALID_INTERFACES)

# its faults are reported here, once
logging.getLogger("can").addHandler(logging.NullHandler())
logging.getLogger("can").propagate = False

# interfaces that pass on error frames of the kernel's form
AS_THE_KERNEL = ("gs_usb", "socketcand", "udp_multicast", "virtual")


class CanDevice(BusDevice):
    """A bus of python-can. A bus without a descriptor is polled at each tick."""

    def __init__(self, config: SourceConfig) -> None:
        """Raises SetupError where the bus cannot be opened."""
        super().__init__()
        self._bus = _open_bus(config)
        self._is_as_the_kernel = config.interface in AS_THE_KERNEL

    def fileno(self) -> int:
        with contextlib.suppress(NotImplementedError, can.CanError):
            return int(self._bus.fileno())
        return -1

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _receive(self) -> Frame | None:
        try:
            message = self._bus.recv(0.0)
        except (can.CanError, OSError, ValueError, IndexError) as error:
            is_noise = isinstance(error.__cause__ or error, (ValueError, IndexError))
            raise (ValueError if is_noise else ConnectionError)(str(error)) from None
        if message is None:
            raise BlockingIOError
        if message.is_error_frame:
            known = self._is_as_the_kernel
            told = kinds(message.arbitration_id if known else 0, bytes(message.data))
            self.noticed.bus.update(told)
            return None
        if message.is_remote_frame or message.is_fd:
            self.noticed.foreign += 1
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
    except Exception as error:  # each of python-can's interfaces raises exceptions of its own
        if _is_of_channel(error):
            raise unopened(where, error) from None
        raise SetupError(
            f"source.interface: python-can cannot use {config.interface} ({first_line(error)}); is "
            "its maker's library installed, and source.channel one of its own?"
        ) from None


def _is_of_channel(error: Exception) -> bool:
    """Whether a fault is of the channel, not of a library that is missing: ctypes raises an OSError
    without a number, and an interface that goes on without its library any exception."""
    if isinstance(error, can.CanInterfaceNotImplementedError):
        return False
    is_of_ctypes = type(error) is OSError and error.errno is None
    return isinstance(error, (can.CanError, OSError, ValueError)) and not is_of_ctypes
