"""An SLCAN adapter: its answers to a host's lines, and its lines for a bus's frames."""

import re
from collections import deque

from taxeld_protocol import slcan
from taxeld_protocol.frames import Frame
from taxeld_protocol.slcan import BEL, CR

BUS_RATE = b"S8"  # the only bit rate on the bus: 1 Mbit/s


class Adapter:
    """One adapter on a bus of 1 Mbit/s, which answers each line."""

    def __init__(self) -> None:
        self.heard: deque[bytes] = deque(maxlen=100)  # the host's last commands
        self.reset()

    def reset(self) -> None:
        """It has lost its power."""
        self.is_open = self.is_silent = False
        self.rate = b""

    @property
    def on_bus(self) -> bool:
        """Whether frames pass it to the host."""
        return self.is_open and self.rate == BUS_RATE

    def host(self, line: bytes, t: float = 0.0) -> tuple[bytes, Frame | None]:
        """Take a line of the host's; → the answer, and the frame that goes to the bus."""
        frame = slcan.parse(line, t)
        if frame is None:
            self.heard.append(line)
            return CR if self.command(line) else BEL, None
        if not self.on_bus or self.is_silent:
            return BEL, None
        return b"z\r" if line[:1] == b"t" else b"Z\r", frame

    def bus(self, frame: Frame) -> bytes:
        """The line that the host gets for a frame on the bus."""
        return slcan.encode(frame) if self.on_bus else b""

    def command(self, line: bytes) -> bool:
        """→ whether it was accepted."""
        if line == b"C":
            was_open, self.is_open = self.is_open, False
            return was_open
        if self.is_open:  # all other commands need a closed channel
            return False
        if re.fullmatch(rb"S[0-8]", line):
            self.rate = line
        elif line in (b"O", b"L") and self.rate:
            self.is_open, self.is_silent = True, line == b"L"
        else:
            return False
        return True
