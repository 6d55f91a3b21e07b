"""A CAN interface of the Linux kernel, on a raw socket.

Each frame has the time at which the kernel took it from the driver (SO_TIMESTAMPNS; see
networking/can.rst and networking/timestamping.rst in the kernel's documentation), and the number of
frames that the socket has lost so far (SO_RXQ_OVFL).
"""

import contextlib
import errno
import socket
import struct

from taxeld.config.tables import SourceConfig
from taxeld.source.bus_faults import BusFault, kinds
from taxeld.source.device import AwayError, BusDevice, unopened
from taxeld_protocol.frames import Frame

SO_TIMESTAMPNS, SO_RXQ_OVFL = 35, 40  # Python has no names for them
SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ALL_ERRORS = 101, 2, 0x1FFF_FFFF
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
EXTENDED_MASK, STANDARD_MASK = 0x1FFF_FFFF, 0x7FF

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame
_STAMP = struct.Struct("@ll")  # struct timespec
_LOST = struct.Struct("=I")
_CONTROL_BYTES = socket.CMSG_SPACE(_STAMP.size) + socket.CMSG_SPACE(_LOST.size)


class SocketCanDevice(BusDevice):
    """`source.interface = "socketcan"`."""

    def __init__(self, config: SourceConfig) -> None:
        """Raises SetupError where there is no such interface."""
        super().__init__()
        self._socket = opened(config)
        self._socket.setblocking(False)
        for option in (SO_TIMESTAMPNS, SO_RXQ_OVFL):
            self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
        self._lost = 0  # frames that the socket has lost

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        with contextlib.suppress(OSError):
            self._socket.close()

    def _receive(self) -> Frame | None:
        data, control, _, _ = self._socket.recvmsg(_FRAME.size, _CONTROL_BYTES)
        number, length, payload = _FRAME.unpack(data)
        if len(control) > 1:
            (lost,) = _LOST.unpack(control[1][2])
            self.noticed.bus[BusFault.UNREAD] += lost - self._lost
            self._lost = lost
        if number & ERROR:
            self.noticed.bus.update(kinds(number & EXTENDED_MASK, payload))
            return None
        if number & REMOTE:
            self.noticed.foreign += 1
            return None
        seconds, nanoseconds = _STAMP.unpack(control[0][2])
        extended = number >= EXTENDED
        can_id = number & (EXTENDED_MASK if extended else STANDARD_MASK)
        return Frame(seconds + 1e-9 * nanoseconds, can_id, payload[:length], extended)

    def _send(self, frame: Frame) -> None:
        number = frame.can_id | (EXTENDED if frame.extended else 0)
        self._socket.send(_FRAME.pack(number, len(frame.data), frame.data))


def opened(config: SourceConfig) -> socket.socket:
    """A socket on the configured interface. Raises SetupError where there is no such interface."""
    where = f"{config.interface} {config.channel}"
    try:
        made = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.CAN_RAW)
    except OSError as error:
        raise unopened(where, error) from None
    try:
        # a failing bus sends nothing but error frames
        made.setsockopt(SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ALL_ERRORS)
        made.bind((config.channel,))
    except OSError as error:
        made.close()
        if error.errno == errno.ENODEV:
            raise AwayError(
                f"source.channel: no CAN interface '{config.channel}'; bring it up: "
                f"{bring_up(config)}"
            ) from None
        raise unopened(where, error) from None
    return made


def bring_up(config: SourceConfig) -> str:
    """The command that brings the configured interface up."""
    return f"ip link set {config.channel} up type can bitrate {config.bitrate}"
