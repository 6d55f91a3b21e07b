"""A virtual iCub skin board: obeys its commands and turns values into heads and tails."""

from collections.abc import Mapping, Sequence

from taxeld_protocol import icub
from taxeld_protocol.frames import Frame

DEFAULT_PERIOD_MS = 40


class VirtualBoard:
    """One board; no clock and no transport: its owner asks `due` and sends `scan`."""

    def __init__(self, board: int, triangles: Sequence[int] = range(icub.TRIANGLES)) -> None:
        self.board = board
        self.triangles = sorted(triangles)  # that are enabled
        self.period_ms = DEFAULT_PERIOD_MS
        self.running = False
        self.configured = False  # until then it sends under the old ids
        self.diagnoses = True  # whether tails carry the error word
        self._next_s: float | None = None

    def take(self, frame: Frame) -> None:
        """Obey a command to this board; anything else on the bus is passed over."""
        if frame.extended or frame.can_id != icub.COMMAND | self.board:
            return
        match list(frame.data):
            case [icub.SET_TX_MODE, mode]:
                self.running = mode == 0
            case [icub.SET_BOARD, _, period_ms, _] if period_ms:
                self.period_ms = period_ms
                self.configured = True
            case [icub.SET_TRIANGLES, first, last, _, enable, _, _]:
                chosen = set(range(first, min(last + 1, icub.TRIANGLES)))
                kept = set(self.triangles)
                self.triangles = sorted(kept | chosen if enable else kept - chosen)
                self.configured = True

    def due(self, now_s: float) -> bool:
        """Whether a scan is to be sent now."""
        if not self.running:
            self._next_s = None
            return False
        if self._next_s is not None and now_s < self._next_s:
            return False
        self._next_s = now_s + self.period_ms / 1000.0
        return True

    def scan(
        self, values: Sequence[int], errors: Mapping[int, int] | None = None, t: float = 0.0
    ) -> list[Frame]:
        """The frames of one scan: twelve values (0..255, falling with pressure) a triangle, and
        the error words of triangles that have one."""
        channels = icub.CHANNELS * len(self.triangles)
        if len(values) != channels:
            raise ValueError(f"{len(values)} values for {channels} channels")
        frames: list[Frame] = []
        kind = icub.DATA if self.configured else icub.OLD_DATA
        for i, triangle in enumerate(self.triangles):
            can_id = kind | self.board << 4 | triangle
            own = bytes(values[icub.CHANNELS * i : icub.CHANNELS * (i + 1)])
            word = (errors or {}).get(triangle, 0).to_bytes(2) if self.diagnoses else b""
            head = bytes((icub.HEAD,)) + own[: icub.HEAD_VALUES]
            tail = bytes((icub.TAIL,)) + own[icub.HEAD_VALUES :] + word
            frames += [Frame(t, can_id, head), Frame(t, can_id, tail)]
        return frames
