"""Signals: each is noted when it comes and acted upon between two ticks; none kills unawares.

TERM, INT and QUIT end the daemon, HUP reads the configuration anew, USR1 logs what the daemon knows
and where it is, which is written before the tick has ended, so that it shows where a loop hangs.
XCPU comes to a real-time thread that does not pause (`LimitRTTIME=`), and ABRT from a watchdog that
waits in vain: either says where the process is, and ends it. The others that would end a process
are logged and ignored.

All handlers are Python's own, which run between two of its steps. `faulthandler.register` and
`enable` are not used: they look at stacks that may be half made, and give all handlers a small
stack of their own, which a few signals at once overflow; either ends the process.
"""

import faulthandler
import json
import logging
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, Self

from taxeld.config import file as config_file
from taxeld.config.tables import Config
from taxeld.config.toml_tables import ConfigError
from taxeld.service import log as service_log

STDERR = 2  # by its number: Python may be without the object
STOP = (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT)
IGNORED = (
    *(signal.SIGUSR2, signal.SIGALRM, signal.SIGVTALRM, signal.SIGPROF),
    *(signal.SIGPOLL, signal.SIGPWR, signal.SIGSTKFLT),
    *range(signal.SIGRTMIN, signal.SIGRTMAX + 1),
)

log = logging.getLogger(__name__)


class Signals:
    """The signals that the process gets while this is entered; in the main thread."""

    def __init__(self) -> None:
        self._noted: list[int] = []
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGHUP, signal.SIGUSR1, *IGNORED):
            self._before[number] = signal.signal(number, self._note)
        for number in (signal.SIGXCPU, signal.SIGABRT):
            self._before[number] = signal.signal(number, _end)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def stop_by(self, stop: Callable[[], None]) -> None:
        """From now on, who ends the process has `stop` called, which only takes note."""
        for number in STOP:
            self._before[number] = signal.signal(number, lambda *_: stop())

    def serve(self, actions: Mapping[int, Callable[[], None]]) -> None:
        """Act upon what has come since, once each; what has no action is logged."""
        while self._noted:
            number = self._noted.pop(0)
            if number in actions:
                actions[number]()
            else:
                log.warning("signal %s: ignored", _name(number))

    def _note(self, number: int, _: FrameType | None) -> None:
        if number in self._noted:
            return
        self._noted.append(number)
        if number == signal.SIGUSR1:
            faulthandler.dump_traceback(STDERR, all_threads=True)


def reload(path: Path, config: Config, level: str | None = None) -> None:
    """Take from the configuration what can be taken while it runs; the rest needs a restart.
    `level`: of the log, which the command line has set."""
    try:
        new = config_file.load(path)
    except ConfigError as error:
        log.error("%s; going on as before", "; ".join(error.faults))
        return
    level = level or new.log.level
    service_log.set_level(level)
    others = [
        name
        for name in Config.__dataclass_fields__
        if name != "log" and getattr(new, name) != getattr(config, name)
    ]
    rest = f"; a restart is needed for what changed in {', '.join(others)}" if others else ""
    log.warning("%s: read again, log.level is %s%s", path, level, rest)


def dump(state: Mapping[str, object]) -> None:
    """Log what the daemon knows, a line a part."""
    for name, part in state.items():
        log.warning("%s: %s", name, json.dumps(part, default=str))


def _end(number: int, _: FrameType | None) -> None:
    """Say where the process is, and have it end by the signal."""
    faulthandler.dump_traceback(STDERR, all_threads=True)
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return str(number)
