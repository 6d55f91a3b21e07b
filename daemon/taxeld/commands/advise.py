"""`taxeld advise`: where to touch next, by the scans that a running daemon remembers.

A client: the daemon hands over what it has felt, and this process learns it by the same estimator.
"""

import io
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from taxeld.advice.advice import Advice, Advisor, Approach
from taxeld.advice.lines import Reach
from taxeld.commands import running
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.scans import Arrays, scans_of
from taxeld.model import se2
from taxeld.service.prepare import prepared

LOOK_S = 0.2  # pause between two questions
OTHER = "the daemon has another scene, skin or filter than this configuration: name the one it runs"


class Adviser:
    """Advises by a configuration's objects and skins, and by remembered scans."""

    def __init__(self, config: Config, reach: Reach | None = None) -> None:
        """Raises SetupError where a file that the configuration names cannot be used."""
        if not config.scene.names:
            raise SetupError("scene.bundle: is empty; advice is on an object")
        pipeline = prepared(config, time.time()).pipeline
        self._estimator = pipeline.estimator
        calibrations = [stage.calibration for stage in pipeline.stages]
        self._mounts = [None if one is None else one.mount for one in calibrations]
        self._advisor = Advisor(self._estimator, reach)

    def advise(self, memory: Arrays) -> Advice:
        """Advice by the scans of a daemon's `memory`, in the poses that the robot sends.

        Raises:
            SetupError: the daemon's configuration is another one.
        """
        if memory["digest"].item() != self._estimator.digest:
            raise SetupError(OTHER)
        self._estimator.reset()
        self._estimator.learn(scans_of(memory))
        advice = self._advisor.advise()
        return replace(advice, approaches=tuple(map(self._as_robot, advice.approaches)))

    def _as_robot(self, one: Approach) -> Approach:
        mount = self._mounts[one.link]
        if mount is None:
            return one
        back = se2.inverse(mount)
        before, at, until = (se2.compose(p, back) for p in (one.before, one.at, one.until))
        return replace(one, before=before, at=at, until=until)


def remembered(endpoint: str) -> Arrays:
    """The scans that the daemon at a control endpoint remembers, as `estimator.scans` packs them.

    Raises:
        SetupError: no daemon answers, or it has felt nothing yet.
    """
    packed = running.answer(endpoint, "memory")["memory"]
    with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
        return dict(arrays)


def advise(config: Config, reach: Reach | None = None) -> Advice:
    """Where to touch next: by what the daemon of a configuration has felt so far.

    Raises:
        SetupError: it does not answer, has felt nothing, or has another configuration.
    """
    return next(follow(config, reach, lambda: False))


def follow(config: Config, reach: Reach | None, stopping: Callable[[], bool]) -> Iterator[Advice]:
    """Advice now, and each time that the daemon has felt more, until `stopping`. Raises
    SetupError, as `advise`."""
    adviser, before = Adviser(config, reach), dict[str, bytes]()
    while not stopping():
        memory = remembered(config.control.endpoint)
        now = {name: values.tobytes() for name, values in memory.items()}
        if now != before:
            before = now
            yield adviser.advise(memory)
        time.sleep(LOOK_S)


def as_json(advice: Advice, names: tuple[str, ...]) -> str:
    """One line of JSON; `names` are of the links."""
    approaches = []
    for one in advice.approaches:
        poses = {name: getattr(one, name).tolist() for name in ("before", "at", "until")}
        named = {name: dict(zip(("x", "y", "theta"), p, strict=True)) for name, p in poses.items()}
        approaches.append(asdict(one) | named | {"name": names[one.link]})
    found = {"contacts": advice.contacts, "enough": advice.is_enough, "approaches": approaches}
    return json.dumps(found)


def lines(advice: Advice, names: tuple[str, ...]) -> Iterator[str]:
    """Lines for a person; `names` are of the links."""
    free = ", best first:" if advice.approaches else ": no approach is free"
    says = ": no touch would tell more" if advice.is_enough else free
    yield f"after {advice.contacts} contacts{says}"
    for number, one in enumerate(advice.approaches, 1):
        of = f" with {names[one.link]}" if names[one.link] else ""
        yield f"{number}. from {_place(one.before)}, yaw {one.before[2]:.3f} rad{of}"
        along, deep = math.degrees(one.direction), 1e3 * one.depth_m
        yield f"   along {along:.0f}°, until {_place(one.until)} at most"
        yield f"   contact expected at {_place(one.at)}; then press {deep:.1f} mm"
        chances = f"touches {one.p_touch:.0%}, sure afterwards {one.p_sure:.0%}"
        yield f"   {chances}, gain {1e3 * one.gain:.1f} mm"


def _place(pose: Any) -> str:
    return f"x {pose[0]:.4f} m, y {pose[1]:.4f} m"
