"""The other end of a serial line, on a pseudo-terminal: full, or a late adapter's."""

import os
import time
import tty
from contextlib import suppress

from taxeld_protocol.slcan import split
from tests.rig.adapters import KINDS


class FarEnd:
    """The other end of a pseudo-terminal, which reads when it is told to."""

    def __init__(self) -> None:
        self._fd, self._slave = os.openpty()
        tty.setraw(self._slave)
        for end in (self._fd, self._slave):
            os.set_blocking(end, False)
        self.device = os.ttyname(self._slave)

    def fill(self) -> None:
        """What the host wrote before takes all the room there is, also what the kernel makes."""
        for _ in range(10):
            with suppress(BlockingIOError):
                while True:
                    os.write(self._slave, bytes(4096))
            time.sleep(0.01)

    def close(self) -> None:
        os.close(self._fd)
        os.close(self._slave)


APART_S = 0.03  # time between the answers to lines that came together


class LateAdapter(FarEnd):
    """Lawicel's, which answers each line later by the test's clock."""

    def __init__(self, late_s: float, mute: bytes) -> None:
        """`mute`: a line that it does not answer."""
        super().__init__()
        self._late_s, self._mute = late_s, mute
        self.adapter, self._rest = KINDS["lawicel"](), b""
        self._answers: list[tuple[float, bytes]] = []

    def serve(self, now_s: float) -> None:
        with suppress(BlockingIOError):
            lines, self._rest = split(self._rest + os.read(self._fd, 4096))
            answers = [(line, self.adapter.host(line)[0]) for line in lines]
            self._answers += [
                (now_s + self._late_s + k * APART_S, a)
                for k, (line, a) in enumerate(answers)
                if line != self._mute
            ]
        while self._answers and self._answers[0][0] <= now_s:
            os.write(self._fd, self._answers.pop(0)[1])
