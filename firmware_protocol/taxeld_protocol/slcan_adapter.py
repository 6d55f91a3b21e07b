"""The host's half of the talk with an SLCAN adapter: opens its channel, keeps it open, and knows
which line an answer is for.

Pure: lines and the time in, commands out. Adapters differ in what they answer and in how they are
told to listen, and some say nothing at all; so each step waits for an answer, though not for long.
"""

from collections import deque
from collections.abc import Generator
from typing import NamedTuple

from taxeld_protocol.slcan import ACCEPTED, BEL, BITRATES, CR

CLOSE, OPEN = b"C", b"O"
LISTEN = b"L"  # Lawicel's: open, and listen only
SILENT, NORMAL = b"M1", b"M0"  # CANable's: what the next OPEN is to be; it has no LISTEN
FRAMES = (b"t", b"T", b"r", b"R", b"d", b"D", b"b", b"B")  # first letters of what a bus brings
SHORTEST = 5  # bytes of a frame's line

ANSWER_S = 0.2  # that an answer may take; a USB adapter's needs some 0.02
SETTLE_S = 0.05  # at first, in which answers to a host before us are let pass
FORGET_S = 1.0  # a line that was not answered by then will not be
ASKED_MAX = 256  # lines whose answers are looked out for
# what may be refused and is no fault: a channel that is closed already, and another's dialect
MAY_BE_REFUSED = (CLOSE, LISTEN, NORMAL)

Opening = Generator[tuple[bytes, ...], bool | None, tuple[bytes, ...]]


class Asked(NamedTuple):
    """A line on its way, or at the adapter."""

    line: bytes
    until_s: float


class Adapter:
    """One adapter: its lines go to `hear`, what `due` gives goes to it.

    A channel from which nothing has come for `silence_s` is closed and opened again, and so on
    until something comes: whoever closed it, and whatever bit rate it was given.
    """

    def __init__(self, bitrate: int, *, listen_only: bool, silence_s: float = 1.0) -> None:
        self.silence_s = silence_s
        self.is_open = False  # as far as is known: whether it takes frames
        self.silences = 0  # times that it fell silent,
        self.is_silent = False  # and whether it is so
        self.refused = 0  # lines, since start
        self.complaints: list[bytes] = []  # refused lines that are to be said
        self._rate = BITRATES[bitrate]
        self._listen_only = listen_only
        self._asked: deque[Asked] = deque(maxlen=ASKED_MAX)
        self._said: set[bytes] = set()  # complained of, by first letter, and not accepted since
        self._traffic = False  # whether a frame has come since `due` was called
        self._opening: Opening | None = None
        self._awaited: Asked | None = None  # the opening goes on with this one's answer,
        self._answer: bool | None = None
        self._go_on_s = 0.0  # or without it from here on
        self._begin_s: float | None = None  # when the channel is opened first,
        self._reopen_s: float | None = None  # and again, if nothing comes
        self._heard_listen = False  # LISTEN was accepted, however late

    def hear(self, lines: list[bytes]) -> None:
        """What has come, in lines as `slcan.split` gives them."""
        for line in lines:
            if line in ACCEPTED:
                self._answered(accepted=True)
            elif line[-1:] == BEL:
                self._answered(accepted=False)
            elif len(line) >= SHORTEST and line.startswith(FRAMES):
                self._traffic = True

    def sent(self, line: bytes, now_s: float) -> None:
        """A frame's line was handed to the adapter, which may answer it."""
        self._asked.append(Asked(line.removesuffix(CR), now_s + FORGET_S))

    def due(self, now_s: float) -> bytes:
        """The commands to send now; to be called often."""
        while self._asked and self._asked[0].until_s < now_s:
            self._asked.popleft()
        if self._begin_s is None:
            self._begin_s = now_s + SETTLE_S
            return CLOSE + CR
        if self._reopen_s is None:
            return b"" if now_s < self._begin_s else self._begin(now_s)
        if self._traffic:
            self._traffic = self.is_silent = False
            self._reopen_s = now_s + self.silence_s
        if self._opening is not None:
            waits = self._answer is None and now_s < self._go_on_s
            return b"" if waits else self._go_on(now_s)
        if now_s < self._reopen_s:
            return b""
        if not self.is_silent:
            self.is_silent = True
            self.silences += 1
        return self._begin(now_s)

    def closing(self) -> bytes:
        """The commands that leave the adapter as others expect to find it."""
        return b"C\rM0\r" if self._listen_only and not self._heard_listen else b"C\r"

    def _begin(self, now_s: float) -> bytes:
        self.is_open = self._heard_listen = False
        self._reopen_s = now_s + self.silence_s
        self._opening = self._open()
        return self._go_on(now_s)

    def _open(self) -> Opening:
        # twice, as the first only ends what a host that died had begun to write; not an empty line,
        # at which some adapters do their last command again
        closed = (CLOSE, CLOSE, self._rate)
        if not self._listen_only:
            yield (*closed, NORMAL, OPEN)  # a host before us may have left it silent
            return ()
        if (yield (*closed, LISTEN)):
            return ()
        refused = (yield (SILENT,)) is False
        return () if refused or self._heard_listen else (OPEN,)

    def _go_on(self, now_s: float) -> bytes:
        """The opening's next commands."""
        assert self._opening is not None  # noqa: S101  (called while there is one)
        answer, self._answer = self._answer, None
        try:
            commands = self._opening.send(answer)
        except StopIteration as end:
            commands, self._opening, self._awaited = end.value, None, None
            self.is_open = True
            self._reopen_s = now_s + self.silence_s
        asked = [Asked(command, now_s + FORGET_S) for command in commands]
        self._asked += asked
        if self._opening is not None:
            self._awaited, self._go_on_s = asked[-1], now_s + ANSWER_S
        return b"".join(command + CR for command in commands)

    def _answered(self, *, accepted: bool) -> None:
        if not self._asked:
            return  # nothing that we know of
        asked = self._asked.popleft()
        if asked is self._awaited:
            self._answer = accepted
        kind = asked.line[:1]
        if accepted:
            self._said.discard(kind)
            self._heard_listen |= asked.line == LISTEN
        elif asked.line not in MAY_BE_REFUSED:
            self.refused += 1
            if kind not in self._said:
                self._said.add(kind)
                self.complaints.append(asked.line)
