"""A device without hardware: it hears what a test gives it, and keeps what it is sent."""

from taxeld.source.device import Device, LostError, request_frame
from taxeld_protocol.frames import Frame


class GivenDevice(Device):
    def __init__(self) -> None:
        super().__init__()
        self.frames: list[Frame] = []  # read next
        self.sent: list[Frame] = []
        self.is_lost = False

    def read(self) -> list[Frame]:
        if self.is_lost:
            raise LostError from OSError("gone")
        heard, self.frames = self.frames, []
        return heard

    def send(self, to: int, command: int, payload: bytes) -> Frame:
        self.sent.append(request_frame(to, command, payload))
        return self.sent[-1]

    def close(self, wait_s: float = 0.0) -> None:
        """Nothing is held open."""
