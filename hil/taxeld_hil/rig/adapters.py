"""SLCAN adapters: their answers to a host's lines, and their lines for a bus's frames."""

import re
from collections import deque
from typing import NamedTuple

from taxeld_protocol import slcan
from taxeld_protocol.frames import Frame
from taxeld_protocol.slcan import BEL, CR

BUS_RATE = b"S8"  # the only bit rate on the bus: 1 Mbit/s


class AdapterKind(NamedTuple):
    """How one kind of adapter differs from the others."""

    answers: bool = True  # CR or BEL to each line
    listens_by: bytes = b"L"  # opens and listens only; M1 has the next O do so
    stamp_digits: int = 0  # behind a frame's data


KINDS = {
    "lawicel": AdapterKind(stamp_digits=4),  # an adapter whose time stamps are on
    "microseconds": AdapterKind(stamp_digits=8),
    "plain": AdapterKind(),
    "canable2": AdapterKind(answers=False, listens_by=b"M1"),
    "answering canable2": AdapterKind(listens_by=b"M1"),
}


class Adapter:
    """One adapter on a bus of 1 Mbit/s."""

    def __init__(self, kind: str = "plain") -> None:
        self.kind = KINDS[kind]
        self.heard: deque[bytes] = deque(maxlen=100)  # the host's last commands
        self.reset()

    def reset(self) -> None:
        """It has lost its power."""
        self.is_open = self.is_silent = False
        self._rate = b"" if self.kind.answers else b"S4"
        self._last = b""

    @property
    def on_bus(self) -> bool:
        """Whether frames pass it to the host."""
        return self.is_open and self._rate == BUS_RATE

    def host(self, line: bytes, t: float = 0.0) -> tuple[bytes, Frame | None]:
        """Take a line of the host's; → the answer, and the frame that goes to the bus."""
        if not line and not self.kind.answers:
            line = self._last  # this firmware does not look how long a line is
        self._last = line
        frame = slcan.parse(line, t)
        if frame is None:
            self.heard.append(line)
            done = self._command(line)
            return (CR if done else BEL) if self.kind.answers else b"", None
        sent = self.on_bus and not self.is_silent
        answer = (b"z\r" if line[:1] == b"t" else b"Z\r") if sent else BEL
        return answer if self.kind.answers else b"", frame if sent else None

    def bus(self, frame: Frame) -> bytes:
        """The line that the host gets for a frame on the bus."""
        if not self.on_bus:
            return b""
        digits = self.kind.stamp_digits
        stamp = b"%0*X" % (digits, int(frame.t * (1e3 if digits == 4 else 1e6)) % 16**digits)
        return slcan.encode(frame).removesuffix(CR) + (stamp if digits else b"") + CR

    def _command(self, line: bytes) -> bool:
        """→ whether it was accepted."""
        if line == b"C":
            was_open, self.is_open = self.is_open, False
            return was_open
        if self.is_open:  # all other commands need a closed channel
            return False
        if re.fullmatch(rb"S[0-8]", line):
            self._rate = line
        elif line == b"O" and self._rate:
            self.is_open = True
            if self.kind.listens_by == b"L":
                self.is_silent = False
        elif line == self.kind.listens_by == b"L" and self._rate:
            self.is_open = self.is_silent = True
        elif line in (b"M0", b"M1") and self.kind.listens_by == b"M1":
            self.is_silent = line == b"M1"
        else:
            return False
        return True
