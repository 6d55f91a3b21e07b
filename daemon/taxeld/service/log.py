"""The log: lines on standard error, written by a worker of their own.

A reader of standard error that hangs costs lines, but neither a pass of the loop nor the end of the
process. The journal is told how grave each line is; other readers get the time of each.

A loop that hangs is ended by XCPU (`LimitRTTIME=`) or ABRT (a watchdog), and says where it is.
`faulthandler` would give its handlers a small stack, which a few signals at once overflow.
"""

import contextlib
import logging
import os
import select
import signal
import traceback
from collections.abc import Iterator, Mapping
from functools import partial
from types import FrameType

from taxeld.worker import Worker

STDERR = 2  # by its number: the object holds a lock while it writes, also at the process' end
MOST = 1000  # lines that wait to be written; more are dropped
CLOSE_S = 2.0  # that the last lines may take
END_S = 1.0  # that standard error may take for the place where the process is
JOURNAL = {"DEBUG": "<7>", "INFO": "<6>", "WARNING": "<4>", "ERROR": "<3>"}  # sd-daemon(3)

_ROOT = logging.getLogger("taxeld")


class _Marked(logging.Formatter):
    """The journal's mark for the level stands before each line of a record."""

    def format(self, record: logging.LogRecord) -> str:
        mark = JOURNAL.get(record.levelname, "")
        return "\n".join(mark + line for line in super().format(record).split("\n"))


class _Hand(logging.Handler):
    """Hands lines to the worker, if it is not far behind."""

    def __init__(self, worker: Worker) -> None:
        super().__init__()
        self._worker = worker

    def emit(self, record: logging.LogRecord) -> None:
        if self._worker.behind < MOST:
            self._worker.give(partial(_write, self.format(record)))


@contextlib.contextmanager
def written() -> Iterator[None]:
    """Meanwhile, what is logged is written; its level is as before afterwards."""
    for number in (signal.SIGXCPU, signal.SIGABRT):
        signal.signal(number, _end)
    level = _ROOT.level
    worker = Worker("log")
    hand = _Hand(worker)
    hand.setFormatter(formatter(STDERR, os.environ))
    logging.getLogger().addHandler(hand)  # for all loggers: libraries would else write in the loop
    try:
        yield
    finally:
        logging.getLogger().removeHandler(hand)
        _ROOT.setLevel(level)
        worker.close(CLOSE_S)


def formatter(descriptor: int, environ: Mapping[str, str]) -> logging.Formatter:
    """How lines look to the reader of an open file."""
    found = os.fstat(descriptor)
    if environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}":  # systemd.exec(5)
        return _Marked()
    text = "%(asctime)s %(levelname)-7s %(message)s"
    return logging.Formatter(text, "%Y-%m-%dT%H:%M:%S%z")


def set_level(name: str) -> None:
    """Leave out what is less than a `LogConfig.level`."""
    _ROOT.setLevel(name.upper())


def _write(line: str) -> None:
    rest = f"{line}\n".encode("utf-8", "replace")
    with contextlib.suppress(OSError):  # the reader has gone, or the disk is full
        while rest:
            rest = rest[os.write(STDERR, rest) :]


def _end(number: int, frame: FrameType | None) -> None:
    """Say where the process is, if standard error takes it, and have it end by the signal."""
    text = "".join(traceback.format_stack(frame)).encode()[-select.PIPE_BUF :]
    with contextlib.suppress(OSError):
        if select.select([], [STDERR], [], END_S)[1]:
            os.write(STDERR, text)
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
