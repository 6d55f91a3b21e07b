"""iCub frames → scans: heads and tails paired, triangles learned from traffic.

The counts of a scan are `256 − value`: they rise with pressure, as CySkin's do, and are 1..256.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

from taxeld_protocol import icub
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.icub import CHANNELS, TRIANGLES, Answer, Drop, Half
from taxeld_protocol.modules import ABSENT_UID, Module

FORGET_SCANS = 20  # without a triangle: its board was told to send others, and all wait for it
COUNT_OF_ZERO = 256  # the count that a value of 0, the hardest pressure, becomes


@dataclass(frozen=True, slots=True)
class Triangle(Module):
    """A triangle as a module: all twelve channels are sent, the mask says which are taxels."""

    @property
    def names(self) -> list[int]:
        return list(range(self.channels))

    @property
    def uids(self) -> list[int]:
        if self.sui is None:
            return [ABSENT_UID] * self.channels
        return [self.sui << 4 | k if self.mask >> k & 1 else ABSENT_UID for k in self.names]


@dataclass(slots=True)
class IcubCounters:
    """Counters since start."""

    scans: int = 0
    incomplete: int = 0  # scans with a lost channel
    answers: int = 0  # answers to ASK
    no_acknowledge: int = 0  # tails whose error word says that a taxel did not acknowledge
    not_connected: int = 0  # tails whose error word says that no taxel is connected
    out_of_range: int = 0  # tails whose error word has a taxel out of range

    def on_error(self, error: int) -> None:
        self.no_acknowledge += bool(error & icub.NO_ACKNOWLEDGE)
        self.not_connected += bool(error & icub.NOT_CONNECTED)
        self.out_of_range += bool(error >> icub.OUT_OF_RANGE_SHIFT)


@dataclass(slots=True)
class _Board:
    """A board as its traffic shows it, and the scan under way."""

    table: dict[int, Triangle] = field(default_factory=dict)  # triangle → its module, ascending
    version: int = 0
    error: dict[int, int] = field(default_factory=dict)  # a triangle's last error word
    missed: dict[int, int] = field(default_factory=dict)  # a triangle's scans since it came last
    heard: int = 0  # halves since start
    halves: dict[tuple[int, int], Half] = field(default_factory=dict)  # scan's, in wire order
    t: float = 0.0  # time of the scan's first half [s]

    def learn(self, triangle: int, sui: int, taxels: int, version: int) -> None:
        table = self.table | {triangle: Triangle(CHANNELS, sui, taxels)}
        self.table = dict(sorted(table.items()))
        self.version = version

    def forget_silent(self, version: int) -> bool:
        """Whether there were triangles that have not come for long; they are known no more."""
        for triangle in self.table:
            came = (triangle, 0) in self.halves or (triangle, icub.HEAD_VALUES) in self.halves
            self.missed[triangle] = 0 if came else self.missed.get(triangle, 0) + 1
        kept = {t: module for t, module in self.table.items() if self.missed[t] < FORGET_SCANS}
        if len(kept) == len(self.table):
            return False
        self.table, self.version = kept, version
        return True

    def counts(self) -> tuple[int, ...]:
        """Counts of the scan under way, MISSING where a half is lost or the error word says so."""
        counts = [MISSING] * (CHANNELS * len(self.table))
        place = {triangle: CHANNELS * i for i, triangle in enumerate(self.table)}
        for (triangle, first), half in self.halves.items():
            # a head whose tail is lost is judged by the tail before
            unusable = icub.unusable(self.error.get(triangle, 0))
            for channel, value in enumerate(half.values, first):
                if not unusable >> channel & 1:
                    counts[place[triangle] + channel] = COUNT_OF_ZERO - value
        return tuple(counts)


class IcubDecoder:
    """The boards of one skin part on one bus; a `ScanDecoder` whose scans have the board as `ihb`.

    A board's triangles go round in ascending order, head before tail. A scan ends when every known
    triangle has both halves, or where the order steps back, which shows that halves were lost. As
    frames have no counter, the loss of one scan's end together with the next one's start cannot be
    seen. A triangle that has not come in FORGET_SCANS is known no more.
    """

    def __init__(
        self, boards: Sequence[int] = icub.BOARDS, taxels: Mapping[int, int] | None = None
    ) -> None:
        """`boards`: those of the part, in the order of its positions file: the triangles of board
        `boards[i]` get the SUIs 16·i … 16·i + 15. Halves of other boards are foreign.

        `taxels`: by SUI, which channels are taxels (bit k for channel k), none where a triangle is
        not named; without it all twelve channels of every triangle have UIDs.
        """
        self.counters = IcubCounters()
        self.frames = 0
        self.dropped = dict.fromkeys(Drop, 0)
        self.answered: dict[int, Answer] = {}  # the last answer of each board
        self._taxels = taxels
        self._first_sui: dict[int, int] = {}
        self._boards: dict[int, _Board] = {}
        self._tables = 0  # versions given to tables: none comes twice, whatever is assigned
        self.assign(boards)

    def assign(self, boards: Sequence[int]) -> None:
        """Take these for the part's boards from now on; what was learned of others is forgotten."""
        first_sui = {board: TRIANGLES * i for i, board in enumerate(boards)}
        if first_sui != self._first_sui:
            self._first_sui = first_sui
            self._boards.clear()

    def heard(self, board: int) -> int:
        """Halves that a board has sent."""
        return self._boards[board].heard if board in self._boards else 0

    def drop_foreign(self) -> None:
        """Count a frame that is no classic data frame."""
        self.frames += 1
        self.dropped[Drop.FOREIGN] += 1

    def feed(self, frame: Frame) -> tuple[None, list[Scan]]:
        """No packet, and the scans that the frame ends: at most two."""
        answer = icub.read_answer(frame)
        if answer is not None:
            self.frames += 1
            self.counters.answers += 1
            self.answered[answer.board] = answer
            return None, []
        half = icub.read(frame)
        if isinstance(half, Half) and half.board not in self._first_sui:
            half = Drop.FOREIGN
        self.frames += 1
        if isinstance(half, Drop):
            self.dropped[half] += 1
            return None, []
        return None, self._take(half, frame.t)

    def flush(self) -> list[Scan]:
        """The scans that are under way, incomplete: call at the end of a log."""
        scans: list[Scan] = []
        for number, board in self._boards.items():
            self._end(number, board, scans)
        return scans

    def stats(self) -> dict[str, int | dict[str, int]]:
        """All counters; `frames` = `used` + the sum of `dropped` + `pending`."""
        used = self.frames - sum(self.dropped.values())
        return {
            "frames": self.frames,
            "used": used,
            "dropped": {str(cause): count for cause, count in self.dropped.items()},
            "pending": 0,  # a half is used as it comes
            "packets": used - self.counters.answers,  # halves
            "crc_errors": 0,  # these frames have no checksum and no index of their own
            "length_errors": self.dropped[Drop.LENGTH],
            "index_errors": 0,
            "unknown": self.dropped[Drop.FOREIGN] + self.dropped[Drop.MARK],
            **asdict(self.counters),
        }

    def _take(self, half: Half, t: float) -> list[Scan]:
        board = self._boards.setdefault(half.board, _Board())
        board.heard += 1
        scans: list[Scan] = []
        place = half.triangle, half.first
        if board.halves and place <= next(reversed(board.halves)):
            self._end(half.board, board, scans)
        if half.triangle not in board.table:
            sui = self._first_sui[half.board] + half.triangle
            taxels = icub.ALL_CHANNELS if self._taxels is None else self._taxels.get(sui, 0)
            self._tables += 1
            board.learn(half.triangle, sui, taxels, self._tables)
        if half.is_tail:
            board.error[half.triangle] = half.error
            self.counters.on_error(half.error)
        if not board.halves:
            board.t = t
        board.halves[place] = half
        if len(board.halves) == 2 * len(board.table):
            self._end(half.board, board, scans)
        return scans

    def _end(self, number: int, board: _Board, scans: list[Scan]) -> None:
        """Move the scan under way, if there is one, to `scans`."""
        if not board.halves:
            return
        table = tuple(board.table.values())
        scan = Scan(board.t, number, board.counts(), table, board.version)
        self._tables += board.forget_silent(self._tables + 1)
        board.halves = {}
        self.counters.scans += 1
        self.counters.incomplete += not scan.complete
        scans.append(scan)
