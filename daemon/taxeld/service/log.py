"""The log: lines on standard error, written by a thread of their own.

A reader of standard error that hangs costs lines, and never a tick. The journal is told how grave
each line is, a terminal shows it in colour, and a file has the time of each.
"""

import contextlib
import logging
import os
import sys
from collections.abc import Iterator, Mapping
from logging.handlers import QueueHandler, QueueListener
from queue import SimpleQueue
from typing import TextIO

MOST = 1000  # lines that wait to be written; more are dropped
PRIORITY = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}  # sd-daemon(3)
COLOUR = {"DEBUG": "2", "WARNING": "33", "ERROR": "31", "CRITICAL": "31;1"}  # of a terminal

_ROOT = logging.getLogger("taxeld")


class _Hand(QueueHandler):
    """Hands a line to the thread, if it is not far behind."""

    queue: "SimpleQueue[logging.LogRecord]"

    def enqueue(self, record: logging.LogRecord) -> None:
        if self.queue.qsize() < MOST:
            self.queue.put(record)


class _Journal(logging.Formatter):
    """The priority stands before each line of a record; the journal adds the time."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{PRIORITY.get(record.levelname, 5)}>"
        return "\n".join(prefix + line for line in super().format(record).split("\n"))


class _Coloured(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line, colour = super().format(record), COLOUR.get(record.levelname)
        return f"\x1b[{colour}m{line}\x1b[0m" if colour else line


@contextlib.contextmanager
def written() -> Iterator[None]:
    """Meanwhile, what is logged is written; its level is as before afterwards."""
    level = _ROOT.level
    lines: SimpleQueue[logging.LogRecord] = SimpleQueue()
    hand, handler = _Hand(lines), logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter(sys.stderr, os.environ))
    listener = QueueListener(lines, handler)
    _ROOT.addHandler(hand)
    listener.start()
    try:
        yield
    finally:
        _ROOT.removeHandler(hand)
        _ROOT.setLevel(level)
        listener.stop()


def formatter(stream: TextIO, environ: Mapping[str, str]) -> logging.Formatter:
    """How lines look to who reads the stream."""
    if _is_journal(stream, environ.get("JOURNAL_STREAM", "")):
        return _Journal()
    text = "%(asctime)s %(levelname)-7s %(message)s"
    if stream.isatty():
        dull = environ.get("NO_COLOR") or environ.get("TERM") == "dumb"
        return (logging.Formatter if dull else _Coloured)(text, "%H:%M:%S")
    return logging.Formatter(text, "%Y-%m-%dT%H:%M:%S%z")


def set_level(name: str) -> None:
    """Leave out what is less than a `LogConfig.level`."""
    _ROOT.setLevel(name.upper())


def _is_journal(stream: TextIO, where: str) -> bool:
    """Whether the stream is the one that systemd says leads to the journal: DEVICE:INODE."""
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):  # no descriptor, as in a test
        return False
    return where == f"{found.st_dev}:{found.st_ino}"
