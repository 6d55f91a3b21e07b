"""The log: lines on standard error, written by a thread of their own.

A reader of standard error that hangs costs lines, and never a tick.
"""

import contextlib
import logging
import sys
from collections.abc import Iterator
from logging.handlers import QueueHandler, QueueListener
from queue import SimpleQueue

MOST = 1000  # lines that wait to be written; more are dropped

_ROOT = logging.getLogger("taxeld")


class _Hand(QueueHandler):
    """Hands a line to the thread, if it is not far behind."""

    queue: "SimpleQueue[logging.LogRecord]"

    def enqueue(self, record: logging.LogRecord) -> None:
        if self.queue.qsize() < MOST:
            self.queue.put(record)


@contextlib.contextmanager
def written() -> Iterator[None]:
    """Meanwhile, what is logged is written."""
    lines: SimpleQueue[logging.LogRecord] = SimpleQueue()
    hand = _Hand(lines)
    listener = QueueListener(lines, logging.StreamHandler(sys.stderr))
    _ROOT.addHandler(hand)
    listener.start()
    try:
        yield
    finally:
        _ROOT.removeHandler(hand)
        listener.stop()


def set_level(name: str) -> None:
    """Leave out what is less than a `LogConfig.level`."""
    _ROOT.setLevel(name.upper())
