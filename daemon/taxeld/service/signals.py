"""Signals: each is noted when it comes, and acted upon between two passes of the loop.

TERM, INT and QUIT end the daemon, HUP reads the configuration anew, USR1 logs what the daemon
knows, and XCPU (`LimitRTTIME=`) and ABRT (a watchdog) say where the loop is and end it.

All handlers are Python's own: `faulthandler` gives handlers a small stack, which a few signals at
once overflow.
"""

import contextlib
import json
import logging
import os
import select
import signal
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Self

from taxeld.config import file as config_file
from taxeld.config.gate import ConfigError
from taxeld.config.tables import Config
from taxeld.service import log as service_log

STOP = (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT)
END_S = 1.0  # time that standard error may take for the last lines

log = logging.getLogger(__name__)


class Signals:
    """The signals that the process gets while this is entered; in the main thread."""

    def __init__(self) -> None:
        self._noted: set[int] = set()
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._handle(self._note, signal.SIGHUP, signal.SIGUSR1)
        self._handle(_end, signal.SIGXCPU, signal.SIGABRT)
        self._handle(signal.SIG_IGN, signal.SIGUSR2, signal.SIGALRM)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def stop_by(self, stop: Callable[[], None]) -> None:
        """From now on, a signal that ends the process calls `stop`, which only takes note."""
        self._handle(lambda *_: stop(), *STOP)

    def serve(self, actions: Mapping[int, Callable[[], None]]) -> None:
        """Act upon the signals that have come since, once each."""
        while self._noted:
            actions[self._noted.pop()]()

    def _handle(self, handler: Any, *numbers: int) -> None:
        for number in numbers:
            self._before[number] = signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        is_first = number not in self._noted
        self._noted.add(number)  # before the lines, within which the next one may come
        if is_first and number == signal.SIGUSR1:
            log.warning("the loop is at\n%s", "".join(traceback.format_stack(frame)).rstrip())


def reload(path: Path, config: Config) -> None:
    """Take from the configuration what can be taken while it runs; the rest needs a restart."""
    try:
        new = config_file.load(path)
    except ConfigError as error:
        log.error("%s; going on as before", "; ".join(error.faults))
        return
    service_log.set_level(new.log.level)
    names = (name for name in Config.__dataclass_fields__ if name != "log")
    others = [name for name in names if getattr(new, name) != getattr(config, name)]
    rest = f"; a restart is needed for what changed in {', '.join(others)}" if others else ""
    log.warning("%s: read again, log.level is %s%s", path, new.log.level, rest)


def dump(state: Mapping[str, object]) -> None:
    """Log what the daemon knows, a line a part."""
    for name, part in state.items():
        log.warning("%s: %s", name, json.dumps(part, default=str))


def _end(number: int, frame: FrameType | None) -> None:
    """Say where the process is, if standard error takes it, and have it end by the signal."""
    text = "".join(traceback.format_stack(frame)).encode()[-select.PIPE_BUF :]
    with contextlib.suppress(OSError):
        if select.select([], [service_log.STDERR], [], END_S)[1]:
            os.write(service_log.STDERR, text)
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
