"""Kinds of SLCAN adapters, by how they differ from the harness's."""

from functools import partial

from taxeld_hil.rig.adapters import Adapter
from taxeld_protocol.frames import Frame
from taxeld_protocol.slcan import CR


class Stamping(Adapter):
    """Its time stamps are on: of so many digits, behind a frame's data."""

    def __init__(self, digits: int) -> None:
        super().__init__()
        self._digits, self._per_s = digits, 1e3 if digits == 4 else 1e6

    def bus(self, frame: Frame) -> bytes:
        stamp = b"%0*X" % (self._digits, int(frame.t * self._per_s) % 16**self._digits)
        return super().bus(frame).replace(CR, stamp + CR)


class Canable2(Adapter):
    """M1, and not L, has the next O listen only."""

    def command(self, line: bytes) -> bool:
        is_silent = self.is_silent
        if line in (b"M0", b"M1") and not self.is_open:
            self.is_silent = line == b"M1"
            return True
        done = line != b"L" and super().command(line)
        self.is_silent = is_silent
        return done


class MuteCanable2(Canable2):
    """It answers nothing, has a bit rate from the start, and does not look how long a line is."""

    def reset(self) -> None:
        super().reset()
        self.rate, self._last = b"S4", b""

    def host(self, line: bytes, t: float = 0.0) -> tuple[bytes, Frame | None]:
        self._last = line or self._last
        return b"", super().host(self._last, t)[1]


KINDS = {
    "lawicel": partial(Stamping, 4),
    "microseconds": partial(Stamping, 8),
    "plain": Adapter,
    "canable2": MuteCanable2,
    "answering canable2": Canable2,
}
