"""A virtual iCub skin board: obeys its commands as the firmware does, and turns values into halves.

It behaves as the newer board's firmware (MTB4): whatever sets triangles up stops it as well. The
older one (MTB) goes on by itself once it has calibrated; START does no harm there.
"""

from collections.abc import Mapping, Sequence

from taxeld_protocol import icub
from taxeld_protocol.frames import Frame

DEFAULT_PERIOD_MS = 50
KIND, VERSION, PROTOCOL = 11, (1, 4, 2), (1, 0)  # an MTB4's, as it answers


class VirtualBoard:
    """One board; no clock and no transport: its owner asks `due` and sends `scan`."""

    def __init__(self, board: int, triangles: Sequence[int] = range(icub.TRIANGLES)) -> None:
        self.board = board
        self.triangles = sorted(triangles)  # that are enabled; all, after power-up
        self.period_ms = DEFAULT_PERIOD_MS
        self.skin_type = 0
        self.running = False
        self.configured = False  # until then it sends under the old ids
        self.diagnoses = True  # whether tails carry the error word
        self.calibrations = 0
        self._next_s: float | None = None

    def take(self, frame: Frame) -> list[Frame]:
        """Obey a command to this board; anything else on the bus is passed over. → Its answer."""
        if frame.extended or frame.can_id != icub.COMMAND | self.board:
            return []
        match list(frame.data):
            case [icub.GET_VERSION, major, minor]:
                return [self._answer((major, minor), frame.t)]
            case [icub.SET_TX_MODE, mode]:
                self.running = mode == 0
                self.configured |= self.running
            case [icub.SET_BOARD, skin_type, period_ms, _] if period_ms:
                self.skin_type, self.period_ms = skin_type & 0xF, period_ms
                self.triangles = []
                self.configured = True
                self._next_s = None  # one that sends begins its period anew
            case [icub.SET_TRIANGLES, first, last, _, enable, _, _]:
                self._set_triangles(first, last, enable=bool(enable & 1))
        return []

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

    def _set_triangles(self, first: int, last: int, *, enable: bool) -> None:
        if not first <= last < icub.TRIANGLES:
            return
        kept, chosen = set(self.triangles), set(range(first, last + 1))
        self.triangles = sorted(kept | chosen if enable else kept - chosen)
        self.configured = True
        self.calibrations += 1
        self.running = False

    def _answer(self, protocol: tuple[int, int], t: float) -> Frame:
        """To who asks what it is, for a version of the protocol."""
        suits = protocol[0] == PROTOCOL[0] and protocol[1] <= PROTOCOL[1]
        data = bytes((icub.GET_VERSION, KIND, *VERSION, *PROTOCOL, suits))
        return Frame(t, icub.COMMAND | self.board << 4, data)
