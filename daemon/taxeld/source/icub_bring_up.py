"""Bring-up of iCub skin boards: found by asking, configured, their triangles enabled, started.

Pure: the time and what the decoder has heard in, requests out. A request is the board's number and
the command to it. After its first bring-up a board that sends is left alone, as configuring it
makes it calibrate itself anew: under a touch, that would hide the touch.

Commands to a board are spaced out: of those that wait, an MTB obeys the last first.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from taxeld.source.bring_up import RETRY_S, SILENCE_S, Request
from taxeld.source.icub_part import Part, listing
from taxeld_protocol import icub
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.icub import Answer
from taxeld_protocol.icub_decoder import IcubDecoder

SETTLE_S = 1.0  # no further board may answer for so long before those that did are the part's
ANSWER_S = 0.3  # that an answer may take
PAUSE_S = 0.05  # after a command
CALIBRATION_S = 0.4  # and two periods: what a board takes over triangles
PATIENCE_S = 3.0  # silence is spoken of after so long; a board's, beyond its bring-up

CURE = (
    "see that they have power and are on this bus; those behind an Ethernet board (EMS) cannot be "
    "reached over CAN"
)

Step = tuple[bytes, float]  # a command, and the pause after it


@dataclass(slots=True)
class _Board:
    """A board's bring-up: the step that is next, and when."""

    number: int
    steps: list[Step]  # the first asks
    at: int = 0  # beyond the last: it is listened to
    due_s: float = -math.inf
    heard: int = 0  # halves, when last looked
    heard_s: float = -math.inf  # when there were new ones, or when it was begun
    answer: Answer | None = None  # to the last asking
    heard_at_asking: int = 0
    is_set_up: bool = False  # all steps were taken before
    # without an answer: it may be too old for the question, or have come up amidst the steps
    is_blind: bool = False

    def is_silent(self, now_s: float) -> bool:
        """For longer than its steps take."""
        return now_s >= self.heard_s + PATIENCE_S + sum(pause_s for _, pause_s in self.steps)

    def listen(self, now_s: float) -> None:
        """It speaks: leave it alone for as long as it does."""
        self.at, self.heard_s, self.due_s = len(self.steps), now_s, now_s + SILENCE_S


class IcubBringUp:
    """Decides what to send to get scans and to keep them coming."""

    def __init__(
        self,
        decoder: IcubDecoder,
        part: Part,
        boards: Sequence[int],
        period_ms: int,
        skin_type: int = icub.SKIN_TYPE,
    ) -> None:
        """`boards`: the part's, in its order; none: those that answer, ascending."""
        self.waits_for = ""  # what must come before all taxels can, in a line
        self._decoder = decoder
        self._part = part
        self._named = tuple(boards)
        self._head = [(icub.ASK, ANSWER_S), (icub.set_board(period_ms, skin_type), PAUSE_S)]
        self._calibration_s = CALIBRATION_S + 2 * period_ms / 1000.0
        self._boards: list[_Board] = []
        self._answered: tuple[int, ...] = ()  # so far, while they are being found
        self._begun_s = self._found_s = math.inf  # asking began; another board answered
        self._next_s = -math.inf
        if self._named:
            self._begin(self._named)

    def restart(self) -> None:
        """Begin again at once: the device was opened anew."""
        for board in self._boards:
            board.at, board.due_s, board.heard_s = 0, -math.inf, -math.inf
        self._next_s = -math.inf

    @staticmethod
    def on_packet(_: Packet) -> list[Request]:
        """These boards send none."""
        return []

    @staticmethod
    def news() -> list[str]:
        """Nothing: what is silent shows in the counters."""
        return []

    def on_scan(self, ihb: int, now_s: float) -> None:
        """Not needed: `due` looks at what the decoder has had from each board."""

    def due(self, now_s: float) -> list[Request]:
        """The requests to send now."""
        if not self._boards:
            requests = self._find(now_s)
            if not self._boards:
                self.waits_for = self._not_found(now_s)
                return requests
        requests = [request for board in self._boards for request in self._step(board, now_s)]
        self.waits_for = self._silent(now_s)
        return requests

    def stop(self) -> list[Request]:
        return [(board.number, icub.STOP) for board in self._boards]

    def _begin(self, boards: Sequence[int]) -> None:
        """Take these for the part's. Those that have none of its triangles are left alone."""
        self._decoder.assign(boards)
        self._boards = [
            _Board(number, [*self._head, *self._triangles(mask), (icub.START, SILENCE_S)])
            for number, mask in zip(boards, self._part.triangles, strict=False)
            if mask
        ]

    def _triangles(self, mask: int) -> list[Step]:
        return [
            (icub.set_triangles(first, last), self._calibration_s)
            for first, last in icub.runs(mask)
        ]

    def _find(self, now_s: float) -> list[Request]:
        """Ask at all addresses, until as many boards as the part has answer, and no more."""
        self._begun_s = min(self._begun_s, now_s)
        answered = tuple(sorted(a.board for a in self._decoder.answered.values() if a.is_skin))
        if answered != self._answered:
            self._answered, self._found_s = answered, now_s
        if len(answered) == len(self._part.triangles) and now_s >= self._found_s + SETTLE_S:
            self._begin(answered)
        elif now_s >= self._next_s:
            self._next_s = now_s + RETRY_S
            return [(board, icub.ASK) for board in icub.BOARDS]
        return []

    def _step(self, board: _Board, now_s: float) -> list[Request]:
        """What to send to one board, if anything."""
        heard = self._decoder.heard(board.number)
        speaks, board.heard = heard > board.heard, heard
        if math.isinf(board.heard_s):
            board.heard_s = now_s
        if board.at == len(board.steps):
            if speaks:
                board.listen(now_s)
            if now_s < board.due_s and not (speaks and board.is_blind):
                return []
            board.at = 0
        elif board.at == 1:
            answer = self._decoder.answered.get(board.number)
            is_fine = board.is_set_up and not (board.is_blind and now_s < board.due_s)
            if heard > board.heard_at_asking and is_fine:
                board.is_blind = False
                board.listen(now_s)
                return []
            is_new = answer is not None and (board.is_blind or not board.is_set_up)
            if now_s < board.due_s and not is_new:
                return []
            board.answer, board.is_blind = answer, answer is None
        elif now_s < board.due_s:
            return []
        if board.at == 0:
            self._decoder.answered.pop(board.number, None)
            board.heard_at_asking = heard
        command, pause_s = board.steps[board.at]
        board.at += 1
        board.due_s = now_s + pause_s
        board.is_set_up |= board.at == len(board.steps)
        return [(board.number, command)]

    def _not_found(self, now_s: float) -> str:
        """Why the part's boards are not known yet; nothing while they still may answer."""
        if now_s < self._begun_s + PATIENCE_S:
            return ""
        if not self._answered:
            return f"source.boards: {listing(icub.BOARDS)}: no skin board answers; {CURE}"
        if len(self._answered) == len(self._part.triangles):
            return ""
        return f"source.boards: {self._part.mismatch(self._answered)}"

    def _silent(self, now_s: float) -> str:
        """Which boards send nothing, though they were brought up."""
        silent = [board for board in self._boards if board.is_silent(now_s)]
        if not silent:
            return ""
        if not any(board.answer for board in silent):
            return f"source.boards: {listing([b.number for b in silent])}: no answer; {CURE}"
        said = (f"{b.number} ({f'answers, as {b.answer}' if b.answer else 'no answer'})"
                for b in silent)  # fmt: skip
        return f"source.boards: nothing comes from board {', '.join(said)}"
