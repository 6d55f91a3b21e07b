"""The device end of a transport: an SLCAN adapter or a native serial link on a pseudo-terminal that
can be pulled out, a hub on a CAN interface of this machine's kernel, or arrays that are published.

Frames, lines and arrays are handed over whole: where there is no room, they are refused, never cut.
"""

import contextlib
import errno
import fcntl
import os
import struct
import termios
import tty
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import zmq

from taxeld.door.binding import bound
from taxeld.errors import SetupError
from taxeld_hil.rig.adapters import Adapter
from taxeld_hil.rig.virtual_ihb import HubLink
from taxeld_protocol import slcan
from taxeld_protocol.array import ArrayFrame, line_of
from taxeld_protocol.cyskin import BROADCAST, Command, Packet
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.serial_link import SerialReader

READ_BYTES = 65536
OUTBOX_BYTES = 65536  # beyond what the kernel takes: some tenths of a second of a saturated bus

OnFrame = Callable[[Frame], None]  # called with each frame of the host's


class Port:
    """A transport, as a bench uses it. Unless it says otherwise it stays where it is: it cannot be
    pulled out, and keeps nothing back."""

    is_open = False  # whether a host listens

    def take(self, t: float) -> list[Packet]:
        """The host's requests that have come; `t` stamps their frames."""
        raise NotImplementedError

    def send(self, item: Any) -> bool:
        """Hand a frame, a line (as a Chunk) or an array to the host; False: there was no room."""
        raise NotImplementedError

    def flush(self) -> None:
        """Hand over what waits."""

    def forget(self) -> None:
        """The host has died."""
        self.is_open = False

    def set_plugged(self, plugged: bool) -> None:
        """Pull out the device, once what was sent is read; or plug it in."""

    def close_channel(self) -> None:
        """Another process closes the adapter's channel."""

    def close(self) -> None:
        raise NotImplementedError


class Terminal(Port):
    """A pseudo-terminal behind a name that outlives it."""

    def __init__(self, link: Path) -> None:
        """Raises SetupError where the name cannot be had."""
        self._link = link
        self._fds: tuple[int, ...] = ()  # the master's and the slave's
        self._outbox = bytearray()
        self.set_plugged(True)

    def fileno(self) -> int:
        return self._fds[0] if self._fds else -1

    @property
    def slave(self) -> int:
        """The host's end of a device that is plugged in, as something else has it open."""
        return self._fds[1]

    def set_plugged(self, plugged: bool) -> None:
        if plugged and not self._fds:
            master, slave = self._fds = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            try:
                self._make_link(os.ttyname(slave))
            except OSError as error:
                self._free()
                raise SetupError(f"{self._link}: cannot be made ({error.strerror})") from None
        elif not plugged and self._fds:
            is_read = not self.waiting() and not self._outbox
            if is_read or not self.is_open:
                self.close()

    def _make_link(self, to: str) -> None:
        """Link to a terminal, in place of a killed process's link. Raises OSError."""
        if self._link.is_symlink() and not self._link.exists():
            self._link.unlink()
        if self._link.is_symlink():
            raise OSError(0, "another skin is there; stop it or remove the link")
        self._link.symlink_to(to)

    def waiting(self) -> int:
        """Bytes in the kernel that the host has not read."""
        found = fcntl.ioctl(self.slave, termios.FIONREAD, b"\0" * 4)
        return int(struct.unpack("i", found)[0])

    def forget(self) -> None:
        super().forget()
        self._outbox.clear()

    def flush(self) -> None:
        if self._fds and self._outbox:
            with contextlib.suppress(BlockingIOError):
                del self._outbox[: os.write(self._fds[0], self._outbox)]

    def close(self) -> None:
        if self._fds:
            self._link.unlink()
            self._free()
            self.forget()

    def _free(self) -> None:
        for fd in self._fds:
            os.close(fd)
        self._fds = ()

    def _write(self, data: bytes) -> bool:
        if len(self._outbox) + len(data) > OUTBOX_BYTES:
            return False
        self._outbox += data
        self.flush()
        return True

    def _read(self) -> bytes:
        if not self._fds:
            return b""
        try:
            return os.read(self._fds[0], READ_BYTES)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):  # EIO: the host has closed
                raise
            return b""


class SlcanPort(Terminal):
    """A USB-CAN adapter with the hub on its bus."""

    def __init__(self, link: Path, on_frame: OnFrame, kind: Callable[[], Adapter] = Adapter):
        self.adapter = kind()
        self._rest, self._has_host = b"", False
        self._requests, self._on_frame = HubLink(), on_frame
        super().__init__(link)

    def take(self, t: float) -> list[Packet]:
        lines, self._rest = slcan.split(self._rest + self._read())
        self._has_host |= bool(lines)
        packets = []
        for line in lines:
            answer, frame = self.adapter.host(line, t)
            self._write(answer)
            if frame is not None:
                self._on_frame(frame)
                packets.append(self._requests.feed(frame))
        self.is_open = self._has_host and self.adapter.on_bus
        return [packet for packet in packets if packet is not None]

    def send(self, item: Frame) -> bool:
        return self._write(self.adapter.bus(item))

    def forget(self) -> None:
        """… and has left the adapter as it was."""
        super().forget()
        self._has_host = False

    def set_plugged(self, plugged: bool) -> None:
        if plugged and not self._fds:
            self._rest = b""
            self.adapter.reset()
        super().set_plugged(plugged)

    def close_channel(self) -> None:
        """… as it does by writing C to the device."""
        self.adapter.host(b"C")
        self.is_open = False


class NativePort(Terminal):
    """A hub on a serial line of its own; the host counts as listening from its first request on, as
    a USB device sees its port opened."""

    def __init__(self, link: Path) -> None:
        self._requests = SerialReader()
        super().__init__(link)

    def take(self, t: float) -> list[Packet]:
        packets = self._requests.feed(self._read(), t)
        self.is_open = self.is_open or bool(packets)
        return packets

    def send(self, item: Chunk) -> bool:
        return self._write(item.data)


class Feed(ExitStack):
    """Publishes at an endpoint, and knows whether somebody listens."""

    def __init__(self, endpoint: str, key: str) -> None:
        """`key` names the endpoint in a message. Raises SetupError where it cannot be had."""
        super().__init__()
        self._prefixes = set[bytes]()  # that somebody has subscribed to
        context: zmq.Context[Any] = self.enter_context(zmq.Context())
        self.socket: zmq.Socket[Any] = self.enter_context(context.socket(zmq.XPUB))
        self.socket.setsockopt(zmq.LINGER, 0)
        try:
            self.enter_context(bound(self.socket, endpoint, key))
        except SetupError:
            self.close()
            raise

    def is_heard(self, topic: bytes = b"") -> bool:
        """Whether somebody listens to a topic. ZeroMQ tells when a prefix gets its first subscriber
        and when it loses its last."""
        while self.socket.poll(0):
            said = self.socket.recv()
            (self._prefixes.add if said[:1] == b"\x01" else self._prefixes.discard)(said[1:])
        return any(topic.startswith(prefix) for prefix in self._prefixes)

    def send(self, *parts: bytes) -> None:
        self.socket.send_multipart(parts, zmq.NOBLOCK)


class ArrayPort(Port):
    """A skin that publishes arrays; a host's subscription starts it."""

    def __init__(self, where: Path) -> None:
        """Raises SetupError where the path cannot be had."""
        self.feed = Feed(f"ipc://{where.absolute()}", "--link")

    def take(self, t: float) -> list[Packet]:
        was_open, self.is_open = self.is_open, self.feed.is_heard()
        asked = Packet(t, BROADCAST, Command.SET_AUTO_SYNC, bytes([self.is_open]))
        return [asked] if self.is_open != was_open else []

    def send(self, item: ArrayFrame) -> bool:
        self.feed.send(line_of(item).encode())
        return True

    def close(self) -> None:
        self.feed.close()


class CanPort(Port):
    """A hub on a CAN interface, such as vcan0, that something else brings up and down."""

    def __init__(self, interface: str, on_frame: OnFrame) -> None:
        """Raises SetupError where there is no such interface."""
        self._requests, self._on_frame = HubLink(), on_frame
        try:
            self._bus = can.Bus(interface="socketcan", channel=interface)
        except (can.CanError, OSError) as error:
            raise SetupError(f"cannot open {interface} ({error})") from None

    def take(self, t: float) -> list[Packet]:
        packets = []
        with contextlib.suppress(can.CanError, OSError):  # a bus that is down has no frames
            # not `recv`, whose time-out is taken from a wall clock that may be set back
            while message := self._bus._recv_internal(0.0)[0]:
                data, extended = bytes(message.data), message.is_extended_id
                frame = Frame(t, message.arbitration_id, data, extended)
                self._on_frame(frame)
                packets.append(self._requests.feed(frame))
        self.is_open = self.is_open or bool(packets)
        return [packet for packet in packets if packet is not None]

    def send(self, item: Frame) -> bool:
        number, data, extended = item.can_id, item.data, item.extended
        message = can.Message(arbitration_id=number, data=data, is_extended_id=extended)
        try:
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError):
            return False
        return True

    def close(self) -> None:
        self._bus.shutdown()
