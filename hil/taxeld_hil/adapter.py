"""A virtual hub behind an SLCAN adapter, alone: no robot, no faults, no ledger (see `ports`)."""

import errno
import os
import tty
from collections.abc import Callable
from typing import Self

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
