"""ZMTP 3.0, as ZeroMQ's sockets speak it: the bytes of a peer → its messages, and back; no I/O.

The NULL mechanism alone (https://rfc.zeromq.org/spec/23). What is held of a peer is bounded.
"""

from collections.abc import Sequence

MORE, LONG, COMMAND = 1, 2, 4  # flags of a frame
MAJOR, MECHANISM = 10, slice(12, 32)  # where they stand in a greeting
NULL = b"NULL".ljust(20, b"\0")
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + NULL + bytes(32)
READY, PING, PONG = b"\x05READY", b"\x04PING", b"\x04PONG"
PING_TTL = 2  # bytes between its name and its context, which is given back
CONTEXT_MAX = 16
KIND = b"socket-type"
NONE: list[bytes] = []  # in place of a message: a command


class StrangerError(Exception):
    """The peer speaks otherwise."""


class OversizedError(Exception):
    """A frame or a message is larger than any that is ours."""


def packed(parts: Sequence[bytes], flags: int = 0) -> bytes:
    """A message, as it goes over the line."""
    last = len(parts) - 1
    return b"".join([_framed(part, flags | MORE * (i < last)) for i, part in enumerate(parts)])


def hello(kind: bytes) -> bytes:
    """All that a socket of this kind says before its messages."""
    return GREETING + packed([READY + b"\x0bSocket-Type" + _sized(kind)], COMMAND)


class Conversation:
    """What one peer says, from its greeting on."""

    __slots__ = ("_buffer", "_frames", "_kinds", "_largest", "_parts", "answer", "is_greeted",
                 "is_ready")  # fmt: skip

    def __init__(self, kinds: frozenset[bytes], largest: int, frames: int) -> None:
        """`kinds`: of sockets that may talk to ours; `largest`: bytes of a frame; `frames`: of a
        message, at most."""
        self.answer = b""  # that a command of the peer's asks for
        self.is_greeted = self.is_ready = False
        self._kinds = kinds
        self._largest = largest
        self._frames = frames
        self._buffer = bytearray()
        self._parts: list[bytes] = []

    def take(self, data: bytes) -> None:
        self._buffer += data

    def next(self) -> list[bytes] | None:
        """The next message of what was taken; NONE in place of a command; None: more must come.

        Raises:
            StrangerError: that is no ZMTP 3, or not from a socket that may talk to ours.
            OversizedError: it is larger than it may be.
        """
        if not self.is_greeted and not self._greet():
            return None
        while (frame := self._frame()) is not None:
            flags, body = frame
            if flags & COMMAND:
                self._obey(body)
                return NONE
            if not self.is_ready:
                raise StrangerError
            self._parts.append(body)
            if not flags & MORE:
                parts, self._parts = self._parts, []
                return parts
            if len(self._parts) == self._frames:
                raise OversizedError
        return None

    def _greet(self) -> bool:
        """Whether the greeting is there, and one of ours."""
        said = self._buffer
        if said[:1] not in (b"", GREETING[:1]):
            raise StrangerError
        if len(said) < len(GREETING):
            return False
        if not said[9] & 1 or said[MAJOR] < GREETING[MAJOR] or said[MECHANISM] != NULL:
            raise StrangerError
        del said[: len(GREETING)]
        self.is_greeted = True
        return True

    def _frame(self) -> tuple[int, bytes] | None:
        said = self._buffer
        start = 9 if said[:1] and said[0] & LONG else 2
        if len(said) < start:
            return None
        flags, size = said[0], int.from_bytes(said[1:start], "big")
        if flags > MORE | LONG | COMMAND or (flags & COMMAND and flags & MORE):
            raise StrangerError
        if size > self._largest:
            raise OversizedError
        if len(said) < start + size:
            return None
        body = bytes(said[start : start + size])
        del said[: start + size]
        return flags, body

    def _obey(self, command: bytes) -> None:
        if not self.is_ready:
            if not command.startswith(READY) or _kind(command[len(READY) :]) not in self._kinds:
                raise StrangerError
            self.is_ready = True
        elif command.startswith(PING):
            context = command[len(PING) + PING_TTL :][:CONTEXT_MAX]
            self.answer = packed([PONG + context], COMMAND)


def _framed(body: bytes, flags: int) -> bytes:
    if len(body) < 256:
        return bytes((flags, len(body))) + body
    return bytes((flags | LONG,)) + len(body).to_bytes(8, "big") + body


def _sized(value: bytes) -> bytes:
    return len(value).to_bytes(4, "big") + value


def _kind(properties: bytes) -> bytes:
    """The socket type among the properties of READY; none where they are damaged."""
    at = 0
    while at < len(properties):
        value = at + 1 + properties[at]
        size = int.from_bytes(properties[value : value + 4], "big")
        if properties[at + 1 : value].lower() == KIND:
            return properties[value + 4 : value + 4 + size]
        at = value + 4 + size
    return b""
