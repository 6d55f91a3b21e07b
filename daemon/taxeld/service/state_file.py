"""The file that a skin's state is kept in: read at the start, written seldom, by its own thread.

It is written beside, synced and then renamed, so that a power cut leaves the old one or the new
one, whole; the directory is not synced, as an older baseline is no loss. Whatever is wrong with
the disk or the file is counted, warned of once, and costs a fresh capture at most.
"""

import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from taxeld.config.file import opened
from taxeld.config.tables import Config
from taxeld.service import state_format
from taxeld.skin.skin import Skin
from taxeld.skin.state import SkinState

NAME = "skin.json"
EVERY_S = 300.0  # out of contact
FUTURE_S = 3600.0  # a state from farther ahead was stored by a wrong clock, or is read by one
CLOSE_S = 2.0  # that the last writing may take
MAX_BYTES = 1_000_000  # ten times what the largest skin takes

log = logging.getLogger(__name__)


@dataclass(slots=True)
class StateCounters:
    """Since start."""

    loaded: int = 0
    refused: int = 0  # files that could not be used
    saved: int = 0
    failed: int = 0  # files that could not be written


def directory(config: Config) -> Path | None:
    """Where the state is kept; None: nowhere. A replayed session leaves no trace."""
    if config.source.kind == "replay":
        return None
    name = config.skin.state_dir or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(name) if name else None


class StateFile:
    """Keeps the state of one skin, if there is a directory to keep it in."""

    def __init__(
        self,
        place: Path | None,
        skin: Skin,
        state: Callable[[], SkinState | None],
        max_age_s: float,
    ) -> None:
        """`state`: what the skin has learned so far, of Unix time."""
        self.counters = StateCounters()
        self._path = place / NAME if place else None
        self._skin = skin
        self._state = state
        self._max_age_s = max_age_s
        self._captures = skin.captures
        self._next_s = -1.0
        self._waiting: SimpleQueue[SkinState | None] = SimpleQueue()  # None: no more will come
        # a disk that hangs must not keep the daemon from ending
        self._thread = threading.Thread(
            target=self._run, args=(self._path,), name="skin state", daemon=True
        )

    def restore(self, now: float) -> None:
        """Give the skin what is stored; `now` is Unix time."""
        if self._path is None:
            return
        try:
            state = self._load(self._path, now)
        except FileNotFoundError:
            return
        except (OSError, ValueError) as error:
            self.counters.refused += 1
            reason = error.strerror if isinstance(error, OSError) else error
            log.warning("%s: not used, %s; the idle baseline is learned again", self._path, reason)
            return
        self.counters.loaded += 1
        self._skin.restore(state)

    def keep(self, now_s: float) -> None:
        """Hand the state to the thread when it is time to, unless one waits there already; `now_s`
        is monotonic. Never blocks."""
        if self._path is None or not self._waiting.empty():
            return
        fresh = self._skin.captures != self._captures
        if fresh or (now_s >= self._next_s and not self._skin.touched):
            self._offer(self._state())
            self._captures, self._next_s = self._skin.captures, now_s + EVERY_S

    def close(self) -> None:
        """Write the last state, unless the disk does not take it in time."""
        if self._path is None:
            return
        self._offer(self._state())
        self._path = None
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join(CLOSE_S)

    def _load(self, path: Path, now: float) -> SkinState:
        """Raises OSError and ValueError, with what is wrong."""
        with opened(path, MAX_BYTES) as file:
            text = file.read(MAX_BYTES)
        skin = self._skin
        state = state_format.parse(text, skin.digest, len(skin.layout), skin.modules)
        age = now - state.t
        if age > self._max_age_s:
            raise ValueError(f"it is {age / 3600.0:.1f} h old")
        if age < -FUTURE_S:
            raise ValueError("it is from the future")
        return state

    def _offer(self, state: SkinState | None) -> None:
        if state is not None:
            self._waiting.put(state)
            if self._thread.ident is None:  # it has not been started
                self._thread.start()

    def _run(self, path: Path) -> None:
        while (state := self._waiting.get()) is not None:
            try:
                _write(path, state_format.dump(state))
            except OSError as error:
                self.counters.failed += 1
                if self.counters.failed == 1:
                    log.warning("%s: not written (%s)", path, error.strerror)
            else:
                self.counters.saved += 1


def _write(path: Path, content: bytes) -> None:
    """In place of a file, or of a link, which is not followed. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".new")
    beside.unlink(missing_ok=True)
    try:
        with beside.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
