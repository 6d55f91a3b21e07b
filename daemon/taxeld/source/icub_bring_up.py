"""Bring-up of iCub skin boards: found by asking, configured, their triangles enabled, started.

Pure: the time and the decoder's state in, requests out. A request is the board's number and the
command to it. After its first bring-up a board that sends is left alone, because configuring it
makes it calibrate itself anew: under a touch, that would hide the touch.

Commands to a board are spaced out, because an MTB obeys the last of several waiting commands first.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from taxeld.config.tables import SourceConfig
from taxeld.source.bring_up import RETRY_S, SILENCE_S, Request
from taxeld.source.icub_part import Part, listing
from taxeld_protocol import icub
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.icub import Answer
from taxeld_protocol.icub_decoder import IcubDecoder

SETTLE_S = 1.0  # time without a further answer after which all boards of the part are found
ANSWER_S = 0.3  # time for an answer
PAUSE_S = 0.05  # pause after a command
CALIBRATION_S = 0.4  # time of a board's calibration of triangles, beside two periods
PATIENCE_S = 3.0  # silence that is reported; a board's counts from the end of its bring-up

CURE = (
    "see that they have power and are on this bus; those behind an Ethernet board (EMS) cannot be "
    "reached over CAN"
)

Step = tuple[bytes, float]  # a command, and the pause after it


@dataclass(slots=True)
class _BoardStart:
    number: int
    steps: list[Step]  # the first step asks
    at: int = 0  # number of the next step; beyond the last the board only sends
    due_s: float = -math.inf
    heard: int = 0  # half scans when last looked
    heard_s: float = -math.inf  # time of the last new half, or of the bring-up's start
    answer: Answer | None = None  # answer to the last question
    heard_at_asking: int = 0
    is_set_up: bool = False  # all steps were taken before
    # The board gives no answer: it may be too old for the question, or have started amid the steps.
    is_blind: bool = False

    def is_silent(self, now_s: float) -> bool:
        """Whether it has been silent for longer than its steps take."""
        return now_s >= self.heard_s + PATIENCE_S + sum(pause_s for _, pause_s in self.steps)

    def listen(self, now_s: float) -> None:
        """The board sends: leave it alone for as long as it does."""
        self.at, self.heard_s, self.due_s = len(self.steps), now_s, now_s + SILENCE_S


class IcubBringUp:
    """Decides what to send to get scans and to keep them coming."""

    is_starting = False  # boards answer and send within a second
    firmware: Mapping[str, str] = MappingProxyType({})  # the answers of boards are in its lines

    def __init__(
        self, decoder: IcubDecoder, part: Part, boards: Sequence[int], config: SourceConfig
    ) -> None:
        """`boards`: the part's, in its order; empty to take the boards that answer, ascending."""
        period_ms = config.period_ms
        setting = icub.set_board(period_ms, config.skin_type, config.no_load_counts)
        self.waits_for = ""  # a line on what must come before all taxels can; or empty
        self._decoder = decoder
        self._part = part
        self._named = tuple(boards)
        self._head = [(icub.ASK, ANSWER_S), (setting, PAUSE_S)]
        self._shift, self._offset = config.shift_bits, config.offset_counts
        self._calibration_s = CALIBRATION_S + 2 * period_ms / 1000.0
        self._boards: list[_BoardStart] = []
        self._answered: tuple[int, ...] = ()  # boards that have answered so far
        # times when asking began, and when the last board answered
        self._begun_s = self._found_s = math.inf
        self._next_s = -math.inf
        if self._named:
            self._begin(self._named)

    def restart(self) -> None:
        """Begin again at once, because the device was opened again."""
        for board in self._boards:
            board.at, board.due_s, board.heard_s = 0, -math.inf, -math.inf
        self._next_s = -math.inf

    def on_packet(self, _: Packet) -> None:
        """Do nothing: these boards send no packets."""

    @staticmethod
    def news() -> list[str]:
        """Return nothing: silent boards show in the counters."""
        return []

    def on_scan(self, ihb: int, now_s: float) -> None:
        """Do nothing: `due` looks at the decoder's counts of each board."""

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
        """Take these boards for the part's. Boards without its triangles are left alone."""
        self._decoder.assign(boards)
        self._boards = [
            _BoardStart(number, [*self._head, *self._triangles(mask), (icub.START, SILENCE_S)])
            for number, mask in zip(boards, self._part.triangles, strict=False)
            if mask
        ]

    def _triangles(self, mask: int) -> list[Step]:
        return [
            (icub.set_triangles(first, last, self._shift, self._offset), self._calibration_s)
            for first, last in icub.runs(mask)
        ]

    def _find(self, now_s: float) -> list[Request]:
        """Ask at all addresses, until exactly as many boards answer as the part has."""
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

    def _step(self, board: _BoardStart, now_s: float) -> list[Request]:
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
        """A line on why the part's boards are not known yet; empty while they still may answer."""
        if now_s < self._begun_s + PATIENCE_S:
            return ""
        if not self._answered:
            return f"source.boards: {listing(icub.BOARDS)}: no skin board answers; {CURE}"
        if len(self._answered) == len(self._part.triangles):
            return ""
        return f"source.boards: {self._part.mismatch(self._answered)}"

    def _silent(self, now_s: float) -> str:
        """A line on boards that send nothing after their bring-up; empty without one."""
        silent = [board for board in self._boards if board.is_silent(now_s)]
        if not silent:
            return ""
        if not any(board.answer for board in silent):
            return f"source.boards: {listing([b.number for b in silent])}: no answer; {CURE}"
        said = (
            f"{b.number} ({f'answers, as {b.answer}' if b.answer else 'no answer'})" for b in silent
        )
        return f"source.boards: nothing comes from board {', '.join(said)}"
