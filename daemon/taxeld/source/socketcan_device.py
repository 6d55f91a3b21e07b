"""A CAN interface of the Linux kernel's, read by its own socket.

python-can makes an object of each frame, by a system call or two each, and takes a tenth of the
time to start and of the memory. Here one call fetches all frames that have arrived, each with the
time at which the kernel took it from the driver (Documentation/networking/can.rst, recvmmsg(2)).
"""

import contextlib
import ctypes
import errno
import os
import socket
import struct
import time

from taxeld.config.tables import SourceConfig
from taxeld.source.device import LostError, Noticed
from taxeld.source.dialects import ToFrames
from taxeld.source.opening import unopened
from taxeld.source.outbox import Unit
from taxeld_protocol.frames import Frame

FRAMES_PER_CALL = 64
CALLS_PER_POLL = 16  # a flooded bus may not hold the loop; the rest waits for the next pass
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is of no Unix clock
SO_TIMESTAMPNS = 35  # which Python has no name for
SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ALL_ERRORS = 101, 2, 0x1FFF_FFFF
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
EXTENDED_MASK, STANDARD_MASK = 0x1FFF_FFFF, 0x7FF

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame
_STAMP = struct.Struct("@ll")  # struct timespec
_STAMP_AT = socket.CMSG_LEN(0)
_CONTROL_BYTES = socket.CMSG_SPACE(_STAMP.size)
_RECORD = struct.Struct(f"@{_STAMP_AT}xll{_CONTROL_BYTES - _STAMP_AT - _STAMP.size}x")


class _Slice(ctypes.Structure):
    """`struct iovec`"""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """`struct msghdr`"""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("slices", ctypes.POINTER(_Slice)),
        ("slice_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """`struct mmsghdr`"""

    _fields_ = (("header", _Header), ("length", ctypes.c_uint))


_libc = ctypes.CDLL(None, use_errno=True)


class FrameSocket:
    """Fetches the frames of a raw CAN socket, which it owns."""

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        most = FRAMES_PER_CALL
        self._frames = ctypes.create_string_buffer(most * _FRAME.size)
        self._control = ctypes.create_string_buffer(most * _CONTROL_BYTES)
        frames, control = ctypes.addressof(self._frames), ctypes.addressof(self._control)
        self._slices = (_Slice * most)()
        self._messages = (_Message * most)()
        for k, message in enumerate(self._messages):
            self._slices[k] = _Slice(frames + k * _FRAME.size, _FRAME.size)
            header = message.header
            header.slices, header.slice_count = ctypes.pointer(self._slices[k]), 1
            header.control = control + k * _CONTROL_BYTES
            header.control_length = _CONTROL_BYTES
        self._fresh = bytes(self._messages)  # as the kernel is to find them

    def fileno(self) -> int:
        return self._socket.fileno()

    def fetch(self) -> list[tuple[float, int, int, bytes]]:
        """At most FRAMES_PER_CALL: (Unix time, id with its flags, length, 8 bytes).

        Raises:
            OSError: the interface is down or gone.
        """
        messages, number = self._messages, self._socket.fileno()
        ctypes.memmove(messages, self._fresh, len(self._fresh))
        came = _libc.recvmmsg(number, messages, FRAMES_PER_CALL, socket.MSG_DONTWAIT, None)
        if came < 0:
            fault = ctypes.get_errno()
            if fault in (errno.EAGAIN, errno.EINTR):
                return []
            raise OSError(fault, os.strerror(fault))
        frames = _FRAME.iter_unpack(memoryview(self._frames)[: came * _FRAME.size])
        stamps = _RECORD.iter_unpack(memoryview(self._control)[: came * _CONTROL_BYTES])
        return [(s + 1e-9 * ns, *frame) for frame, (s, ns) in zip(frames, stamps, strict=True)]

    def send(self, data: bytes) -> None:
        """Raises OSError where it is not taken now."""
        self._socket.send(data)

    def close(self) -> None:
        self._socket.close()


class SocketCanDevice:
    """`source.interface = "socketcan"`."""

    waits_for = ""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        """Raises SetupError where there is no such interface."""
        self.noticed = Noticed()
        self._to_frames = to_frames
        self._bus = FrameSocket(_opened(config))

    def fileno(self) -> int:
        return self._bus.fileno()

    def read(self) -> list[Frame]:
        frames: list[Frame] = []
        now = time.time()
        for _ in range(CALLS_PER_POLL):
            try:
                fetched = self._bus.fetch()
            except OSError as error:
                raise LostError from error
            for t, number, length, data in fetched:
                if number & (ERROR | REMOTE):
                    self.noticed.foreign += 1
                    continue
                extended = number >= EXTENDED
                can_id = number & (EXTENDED_MASK if extended else STANDARD_MASK)
                at = t if abs(t - now) < FOREIGN_CLOCK_S else now
                frames.append(Frame(at, can_id, data[:length], extended))
            if len(fetched) < FRAMES_PER_CALL:
                break
        return frames

    def tend(self, now_s: float) -> None:
        """The kernel keeps it."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        return [Unit(frame) for frame in self._to_frames(command, payload)]

    def put(self, unit: Unit) -> None:
        frame = unit.frame
        assert frame is not None  # noqa: S101  (as packed)
        number = frame.can_id | (EXTENDED if frame.extended else 0)
        try:
            self._bus.send(_FRAME.pack(number, len(frame.data), frame.data))
        except OSError as error:  # full or down: reading tells when it is gone
            raise BlockingIOError from error

    def close(self, wait_s: float = 0.0) -> None:  # noqa: ARG002
        with contextlib.suppress(OSError):
            self._bus.close()


def _opened(config: SourceConfig) -> socket.socket:
    where = f"{config.interface} {config.channel}"
    try:
        opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.CAN_RAW)
    except OSError as error:
        raise unopened(where, error) from None
    try:
        # so that they are counted: a bus that fails sends nothing else
        opened.setsockopt(SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ALL_ERRORS)
        opened.bind((config.channel,))
    except OSError as error:
        opened.close()
        raise unopened(where, error) from None
    return opened
