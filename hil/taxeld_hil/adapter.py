"""A virtual hub where a host can reach it: behind an SLCAN adapter, or on a CAN interface."""

import contextlib
import errno
import os
import tty
from collections.abc import Callable
from typing import Self

import can

from taxeld.errors import SetupError
from taxeld_protocol import cyskin, slcan
from taxeld_protocol.cyskin import Reassembler
from taxeld_protocol.frames import Frame
from taxeld_protocol.virtual_ihb import VirtualIhb

READ_BYTES = 65536


class SlcanAdapter:
    """What a USB-CAN adapter with a CySkin hub on its bus looks like to the host."""

    def __init__(self, ihb: VirtualIhb, on_frame: Callable[[Frame], None]) -> None:
        """`on_frame` hears every frame on the bus, either way, as a logger on it would."""
        self.ihb = ihb
        self.open = False
        self.unsent = 0  # frames the host did not make room for
        self._on_frame = on_frame
        self._requests = Reassembler()
        self._rest = b""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._master)
        os.close(self._slave)

    def fileno(self) -> int:
        return self._master

    def serve(self, t: float) -> None:
        """Take what the host has written and let the hub answer; `t` stamps the frames."""
        try:
            data = os.read(self._master, READ_BYTES)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):  # EIO: the host has closed
                raise
            return
        lines, self._rest = slcan.split(self._rest + data)
        for line in lines:
            frame = slcan.parse(line, t)
            if frame is None:
                self.open = self.open if line[:1] not in (b"O", b"L", b"C") else line[:1] != b"C"
                self._write(slcan.CR)
                continue
            self._on_frame(frame)
            packet = self._requests.feed(frame)
            for command, payload in self.ihb.answer(packet) if packet else []:
                self.send(command, payload, t)

    def send(self, command: int, payload: bytes, t: float) -> None:
        """The hub's packet as frames on the bus."""
        for frame in cyskin.to_frames(command, payload, ihb=self.ihb.short_id, t=t):
            self._on_frame(frame)
            if self.open:
                self._write(slcan.encode(frame))

    def _write(self, data: bytes) -> None:
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        self.unsent += sent < len(data)


class CanAdapter:
    """A hub on a CAN interface of this machine's kernel."""

    def __init__(self, ihb: VirtualIhb, on_frame: Callable[[Frame], None], interface: str) -> None:
        """As `SlcanAdapter`.

        Raises:
            SetupError: there is no such interface.
        """
        self.ihb = ihb
        self.unsent = 0  # frames the bus did not take
        self._on_frame = on_frame
        self._requests = Reassembler()
        try:
            self._bus = can.Bus(interface="socketcan", channel=interface)
        except (can.CanError, OSError) as error:
            raise SetupError(f"--can: cannot open {interface} ({error})") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def fileno(self) -> int:
        return int(self._bus.fileno())

    def serve(self, t: float) -> None:
        """Take what the host has sent and let the hub answer; `t` stamps the frames."""
        with contextlib.suppress(can.CanError, OSError):  # a bus that is down says nothing
            # not `recv`, whose time-out is taken from a wall clock that may be set back
            while message := self._bus._recv_internal(0.0)[0]:
                frame = Frame(t, message.arbitration_id, bytes(message.data))
                self._on_frame(frame)
                packet = self._requests.feed(frame)
                for command, payload in self.ihb.answer(packet) if packet else []:
                    self.send(command, payload, t)

    def send(self, command: int, payload: bytes, t: float) -> None:
        """The hub's packet as frames on the bus."""
        for frame in cyskin.to_frames(command, payload, ihb=self.ihb.short_id, t=t):
            self._on_frame(frame)
            message = can.Message(
                arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
            )
            try:
                self._bus.send(message, timeout=0.0)
            except (can.CanError, OSError):
                self.unsent += 1
