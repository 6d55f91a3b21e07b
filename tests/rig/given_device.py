"""A device without hardware: it hears what a test gives it, and keeps what it is sent."""

from collections.abc import Sequence

from taxeld.source.device import Device, LostError, Piece, frames_of
from taxeld_protocol.frames import Frame


class GivenDevice(Device):
    def __init__(self) -> None:
        super().__init__()
        self.frames: list[Frame] = []  # read next
        self.sent: list[Piece] = []
        self.is_lost = False

    def read(self) -> list[Frame]:
        if self.is_lost:
            raise LostError from OSError("gone")
        heard, self.frames = self.frames, []
        return heard

    def pack(self, to: int, body: bytes) -> Sequence[Piece]:
        return frames_of(to, body)

    def put(self, piece: Piece) -> None:
        self.sent.append(piece)

    def close(self, wait_s: float = 0.0) -> None:
        """Nothing is held open."""
