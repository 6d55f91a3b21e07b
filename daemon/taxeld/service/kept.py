"""What is kept over restarts: what each skin has learned, and the scans of the belief.

Digests say whose both are. What is old or of another configuration is not used.
"""

import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from taxeld.config.tables import Config
from taxeld.estimator.history import VERSION, scan_arrays, scans_of
from taxeld.pipeline.pipeline import Pipeline
from taxeld.service.kept_file import Arrays, KeptFile
from taxeld.skin.skin import Skin
from taxeld.skin.state import SkinState

NAME = "kept.npz"
EVERY_S, AT_LEAST_S = 60.0, 240.0  # between two writings out of contact; where nothing is new
BASELINE_S = 43_200.0  # an idle baseline that was stored longer ago is not used
KEEP_S = 600.0  # what was felt is used by a start that comes so soon
FUTURE_S = 3600.0  # a time farther ahead was stored by a wrong clock, or is read by one


def directory(config: Config) -> Path | None:
    """Where the file is; None: nowhere."""
    name = config.skin.state_dir or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(name) if name else None


class Store:
    """The skins and the belief of one run, and their file, if there is a directory to keep it
    in."""

    def __init__(self, config: Config, pipeline: Pipeline) -> None:
        """The skins take what they learned before."""
        place, self._pipeline = directory(config), pipeline
        self._file = None if place is None else KeptFile(place / NAME)
        self._found: Arrays = {} if self._file is None else self._file.read()
        if self._file and self._found and self._found.get("version") != VERSION:
            self._file.warn("it is of another version: skin and object are learned again")
            self._found = {}
        self._estimator = pipeline.estimator if pipeline.has_object else None
        self._keep_s = KEEP_S if config.filter.motion == "none" else 0.0
        self._digest = self._estimator.digest if self._estimator and self._keep_s else ""
        self._written_s, self._changes, self._captures = -math.inf, 0, 0
        self._is_forgotten = False
        for k, stage in enumerate(pipeline.stages):
            self._restore(k, stage.skin)

    def _restore(self, link: int, skin: Skin) -> None:
        """The taxels' responses last longer than the baseline."""
        stored = _part(f"skin{link}.", self._found)
        if not stored or self._file is None:
            return
        values = {name: value if value.ndim else value.item() for name, value in stored.items()}
        state = SkinState(**values)  # type: ignore[arg-type]
        if state.digest != skin.digest:
            self._file.warn("it is of another skin: the idle baseline is learned again")
            return
        age_s = time.time() - state.t
        is_fresh = -FUTURE_S <= age_s <= BASELINE_S
        skin.restore(state, baseline=is_fresh)
        if not is_fresh:
            hours = age_s / 3600.0
            self._file.warn(f"it is {hours:.1f} h old: the idle baseline is learned again")

    def restore_belief(self) -> None:
        """Have the belief learn again from what an earlier run felt."""
        stored = _part("belief.", self._found)
        self._found = {name: self._found[name] for name in self._found if name.startswith("skin")}
        if not stored or self._file is None or not self._digest:
            return
        age_s = time.time() - stored["t"].item()
        if stored["digest"].item() != self._digest:
            why = "it is of another scene, skin or configuration"
        elif not -FUTURE_S <= age_s <= self._keep_s:
            why = f"it is {age_s:.0f} s old"
        else:
            self._pipeline.restore(scans_of(stored))
            return
        self._file.warn(f"{why}: the object is to be found again")

    def keep(self, now_s: float, wall_s: float) -> None:
        """Have all written if it is time to, at a monotonic and a Unix time. Never blocks."""
        if self._file is None or self._file.is_busy:
            return
        changes = 0 if self._estimator is None else self._estimator.history.changes
        captures = sum(stage.skin.captures for stage in self._pipeline.stages)
        if not self._is_forgotten:
            wait_s = EVERY_S if changes != self._changes else AT_LEAST_S
            is_due = captures != self._captures or now_s >= self._written_s + wait_s
            if not is_due or not (captures or changes) or self._pipeline.is_touched:
                return
        self._written_s, self._changes, self._captures = now_s, changes, captures
        self._is_forgotten = False
        self._file.write(self._content(wall_s))

    def forget_belief(self) -> None:
        """All touches are forgotten, which the next `keep` writes, during a contact as well."""
        self._is_forgotten = True

    def close(self) -> None:
        """Write the last of all, unless the disk does not take it in time."""
        if self._file is None:
            return
        content = self._content(time.time())
        must = self._written_s > -math.inf or self._is_forgotten
        self._file.close(lambda: content() or ({} if must else None))

    def _content(self, t: float) -> Callable[[], Arrays]:
        """Makes the content of Unix time t, from what does not change any more. A skin that is not
        ready yet keeps what was stored of it."""
        states = [self._pipeline.skin_state(k) for k in range(len(self._pipeline.stages))]
        scans = self._estimator.history.kept() if self._estimator and self._digest else []

        def made() -> Arrays:
            found: Arrays = {"version": np.array(VERSION)} if scans or any(states) else {}
            for k, state in enumerate(states):
                values = _part(f"skin{k}.", self._found) if state is None else asdict(state)
                found |= {f"skin{k}.{name}": np.asarray(value) for name, value in values.items()}
            if scans:
                belief = scan_arrays(scans) | {"t": np.array(t), "digest": np.array(self._digest)}
                found |= {f"belief.{name}": value for name, value in belief.items()}
            return found

        return made


def _part(prefix: str, arrays: Arrays) -> Arrays:
    return {name[len(prefix) :]: arrays[name] for name in arrays if name.startswith(prefix)}
