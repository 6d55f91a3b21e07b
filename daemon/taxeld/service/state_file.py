"""The file that a skin's state is kept in: JSON of some 100 kB.

One that cannot be used costs a fresh capture at most.
"""

import json
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld.config.tables import Config
from taxeld.service.kept_file import FUTURE_S, KeptFile
from taxeld.skin.skin import Skin
from taxeld.skin.state import RESPONSE, SkinState

NAME = "skin.json"
VERSION = 2
EVERY_S = 300.0  # between two writings out of contact
MAX_AGE_S = 43_200.0  # a state that was stored longer ago is not used
MAX_BYTES = 1_000_000  # ten times the file of the largest skin
COUNT_MAX = 0xFFFF
ARRAYS = {  # digits, least, most, whether nan is allowed (null in the file)
    "baseline": (2, 0.0, COUNT_MAX, True),
    "noise": (2, 0.0, COUNT_MAX, False),
    "coefficient": (5, -100.0, 100.0, False),
    "leak": (5, 0.0, 1.0, False),
    "t0": (2, -COUNT_MAX, COUNT_MAX, True),
    "gain": (4, 0.1, 10.0, False),
    "onset": (4, -1.0, 10.0, False),
    "log_sag": (3, -12.0, 0.0, False),
    "gain_sd": (4, 1e-4, 10.0, False),
    "onset_sd": (4, 1e-4, 10.0, False),
    "log_sag_sd": (3, 1e-3, 10.0, False),
}
NUMBERS = "full_scale", "calibrated_t"
OF_TAXELS = ("baseline", "noise", *RESPONSE)  # the others are of modules


def dump(state: SkinState) -> bytes:
    """As JSON, in one line."""
    data: dict[str, Any] = {"version": VERSION, "t": round(state.t, 3), "digest": state.digest}
    data |= {name: getattr(state, name) for name in NUMBERS}
    for name, (digits, *_) in ARRAYS.items():
        values = np.round(getattr(state, name), digits).tolist()
        data[name] = [None if math.isnan(value) else value for value in values]
    return json.dumps(data, separators=(",", ":"), allow_nan=False).encode()


def parse(text: bytes, digest: str, taxels: int, modules: int) -> SkinState:
    """The state of the skin `digest` from the bytes of `dump`.

    Raises:
        ValueError: it is damaged, or of another skin.
    """
    try:
        data = json.loads(text)
        if (data["version"], data["digest"]) == (VERSION, digest):
            sizes = {name: taxels if name in OF_TAXELS else modules for name in ARRAYS}
            arrays = {name: _array(data[name], name, size) for name, size in sizes.items()}
            t, full_scale, calibrated_t = (float(data[name]) for name in ("t", *NUMBERS))
            known: dict[str, Any] = {"full_scale": full_scale, "calibrated_t": calibrated_t}
            return SkinState(t=t, digest=digest, **known | arrays)
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
        raise ValueError("it is damaged") from None
    raise ValueError("it is of another skin or version")


def _array(values: Any, name: str, size: int) -> Floats:
    """The numbers (size,) of a list; null is nan."""
    _, low, high, gaps = ARRAYS[name]
    found = np.array(values, dtype=np.float64)
    fine = ((found >= low) & (found <= high)) | (np.isnan(found) & gaps)
    if found.shape != (size,) or not fine.all():
        raise ValueError(name)
    return found


def directory(config: Config, link: str = "") -> Path | None:
    """Where the state is kept; None: nowhere. `link`: name of a further link, whose state is in a
    folder of this name."""
    name = config.skin.state_dir or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(name) / link if name else None


class StateFile:
    """Keeps the state of one skin, if there is a directory to keep it in."""

    def __init__(
        self, place: Path | None, skin: Skin, state: Callable[[], SkinState | None]
    ) -> None:
        """`state`: what the skin has learned so far, of Unix time."""
        self._file = KeptFile(place / NAME, MAX_BYTES) if place else None
        self._skin = skin
        self._state = state
        self._captures = skin.captures
        self._next_s = -1.0

    def restore(self, now: float) -> None:
        """Give the skin what is stored; `now` is Unix time. The taxels' responses last longer than
        the baseline."""

        def take(text: bytes) -> None:
            skin = self._skin
            state = parse(text, skin.digest, len(skin.layout), skin.modules)
            is_fresh = -FUTURE_S <= now - state.t <= MAX_AGE_S
            skin.restore(state, baseline=is_fresh)
            if not is_fresh:
                raise ValueError(f"it is {(now - state.t) / 3600.0:.1f} h old")

        if self._file is not None:
            self._file.read(take, "the idle baseline is learned again")

    def keep(self, now_s: float) -> None:
        """Have the state written if it is time to, and the disk has taken the last one; `now_s` is
        monotonic. Never blocks."""
        if self._file is None or self._file.is_busy:
            return
        fresh = self._skin.captures != self._captures
        if fresh or (now_s >= self._next_s and not self._skin.touched):
            state = self._state()
            if state is not None:
                self._file.write(partial(dump, state))
            self._captures, self._next_s = self._skin.captures, now_s + EVERY_S

    def close(self) -> None:
        """Write the last state, unless the disk does not take it in time."""
        if self._file is not None:
            state = self._state()
            self._file.close(None if state is None else partial(dump, state))
