"""A CAN interface of the Linux kernel, on a raw socket. Neither reading nor writing waits.

Each frame has the time at which the kernel took it from the driver (SO_TIMESTAMPNS; see
networking/can.rst and networking/timestamping.rst in the kernel's documentation).
"""

import contextlib
import socket
import struct
import time

from taxeld.config.tables import SourceConfig
from taxeld.source.device import LostError, Noticed
from taxeld.source.dialects import ToFrames
from taxeld.source.opening import unopened
from taxeld.source.outbox import Unit
from taxeld_protocol.frames import Frame

FRAMES_PER_POLL = 1000  # limit on a pass, so that a flooded bus cannot hold the loop
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is not from this machine's clock
SO_TIMESTAMPNS = 35  # Python has no name for it
SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ALL_ERRORS = 101, 2, 0x1FFF_FFFF
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
EXTENDED_MASK, STANDARD_MASK = 0x1FFF_FFFF, 0x7FF

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame
_STAMP = struct.Struct("@ll")  # struct timespec
_CONTROL_BYTES = socket.CMSG_SPACE(_STAMP.size)


class SocketCanDevice:
    """`source.interface = "socketcan"`."""

    waits_for = ""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        """Raises SetupError where there is no such interface."""
        self.noticed = Noticed()
        self._to_frames = to_frames
        self._socket = opened(config)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._fault: OSError | None = None  # reported after the frames that came before it

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> list[Frame]:
        frames: list[Frame] = []
        now = time.time()
        for _ in range(FRAMES_PER_POLL):
            try:
                data, control, _, _ = self._socket.recvmsg(_FRAME.size, _CONTROL_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                self._fault = error
                break
            number, length, payload = _FRAME.unpack(data)
            if number & (ERROR | REMOTE):
                self.noticed.foreign += 1
                continue
            seconds, nanoseconds = _STAMP.unpack(control[0][2])
            t = seconds + 1e-9 * nanoseconds
            extended = number >= EXTENDED
            can_id = number & (EXTENDED_MASK if extended else STANDARD_MASK)
            at = t if abs(t - now) < FOREIGN_CLOCK_S else now
            frames.append(Frame(at, can_id, payload[:length], extended))
        if self._fault is not None and not frames:
            raise LostError from self._fault
        return frames

    def tend(self, now_s: float) -> None:
        """The kernel keeps the interface."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        return [Unit(frame) for frame in self._to_frames(command, payload)]

    def put(self, unit: Unit) -> None:
        frame = unit.frame
        assert frame is not None  # noqa: S101  (as packed)
        number = frame.can_id | (EXTENDED if frame.extended else 0)
        try:
            self._socket.send(_FRAME.pack(number, len(frame.data), frame.data))
        except OSError as error:  # full or down; reading finds a lost device
            raise BlockingIOError from error

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        with contextlib.suppress(OSError):
            self._socket.close()


def opened(config: SourceConfig) -> socket.socket:
    """A socket on the configured interface. Raises SetupError where there is no such interface."""
    where = f"{config.interface} {config.channel}"
    try:
        made = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.CAN_RAW)
    except OSError as error:
        raise unopened(where, error) from None
    try:
        # error frames are counted: a failing bus sends nothing else
        made.setsockopt(SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ALL_ERRORS)
        made.bind((config.channel,))
    except OSError as error:
        made.close()
        raise unopened(where, error) from None
    return made
