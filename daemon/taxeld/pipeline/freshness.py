"""Whether an estimate is valid, and why it is not.

The estimator judges its belief; this module judges the inputs, and where they stop the estimates,
the status. Both are decided nowhere else.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from taxeld.estimator.estimate import Estimate, Status

LEAST_P = 0.05  # of a valid estimate: what one touch leaves, 20 mm of an outline of 0.4 m


class Why(IntEnum):
    """Why an estimate is not valid: the first reason that holds, in this order."""

    VALID = 0
    NO_SCAN = 1
    STARTING = 2
    SCANS_MISTIMED = 3
    NO_POSE = 4
    MODULES_MISSING = 5
    BLIND = 6
    INCONSISTENT = 7
    UNTOUCHED = 8
    VAGUE = 9
    OUTSIDE = 10
    NO_OBJECT = 11


OF_STATUS = {Status.BLIND: Why.BLIND, Status.INCONSISTENT: Why.INCONSISTENT}
CURES = {  # the reason and its cure, in the width of a terminal (docs/stream.md)
    Why.VALID: "",
    Why.NO_SCAN: "no scan comes from the skin: see Device and Bus",
    Why.STARTING: "the idle baseline is being learned: leave the skin untouched",
    Why.SCANS_MISTIMED: "scans come too late, or from the future: see to load and clock",
    Why.NO_POSE: "no sensor pose near the time of a scan: see Sensor poses",
    Why.MODULES_MISSING: "modules of skin.layout are on no hub: see Modules",
    Why.BLIND: "no live taxel where a touch is expected: turn the skin, see Dead taxels",
    Why.INCONSISTENT: "it moved, or is another object: taxeld reset; or poses err: theta, axes?",
    Why.UNTOUCHED: "nothing was touched yet: touch the object",
    Why.VAGUE: f"p is under {LEAST_P:.0%}: touch another side; is it this object?",
    Why.OUTSIDE: "outside filter.centre_m ± filter.half_width_m: widen or move that square",
    Why.NO_OBJECT: "no object is configured: /taxeld/contacts has what is touched",
}


@dataclass(slots=True)
class LinkInputs:
    """What became of a link's last scan, and when it came."""

    last: Why = Why.STARTING  # VALID where the estimator has taken it
    is_whole: bool = True  # the hubs have the modules that the layout has
    came_s: float = 0.0  # monotonic time

    def why(self, now_s: float | None, stale_s: float) -> Why:
        """As in `Freshness.of_links`; `stale_s`: age [s] beyond which the scan is stale."""
        if now_s is not None and now_s - self.came_s > stale_s:
            return Why.NO_SCAN
        is_missing = self.last is Why.VALID and not self.is_whole
        return Why.MODULES_MISSING if is_missing else self.last


class Freshness:
    """Judges estimates by their inputs. An estimate is of use while one link works: a link that
    does not only leaves its own touches out."""

    def __init__(
        self,
        links: Sequence[LinkInputs],
        stale_s: float,
        centre_m: tuple[float, float],
        half_width_m: float,
        reach_m: float,
    ) -> None:
        """`stale_s`: age of the last scan [s] beyond which the inputs are stale. An object may be
        `half_width_m` from `centre_m` along x and y, and is felt up to `reach_m` from the link's
        axis."""
        self.links, self._stale_s = links, stale_s
        self._centre_m, self._half_width_m, self._reach_m = centre_m, half_width_m, reach_m

    def came(self, now_s: float, link: int | None = None) -> None:
        """A scan of a link, or of each, has come at the monotonic time `now_s`, used or not."""
        for each in self.links if link is None else [self.links[link]]:
            each.came_s = now_s

    def of_links(self, now_s: float | None = None) -> list[Why]:
        """For each link, why its scans are of no use, VALID where they are: with the monotonic time
        `now_s` also by the age of the last one."""
        return [each.why(now_s, self._stale_s) for each in self.links]

    def judged(self, estimate: Estimate, now_s: float | None = None) -> Estimate:
        """The estimate with the status that its inputs allow; `now_s` as in `of_links`."""
        why = self._of_inputs(now_s)
        if why in (Why.VALID, Why.MODULES_MISSING):
            return estimate
        stopped = Status.STARTING if why is Why.STARTING else Status.STALE
        return replace(estimate, status=stopped)

    def why(self, estimate: Estimate, now_s: float | None = None) -> Why:
        """Why a subscriber may not use the last estimate, VALID where it may; `now_s` as above."""
        inputs = self._of_inputs(now_s)
        if inputs is not Why.VALID:
            return inputs
        if not estimate.objects:
            return Why.NO_OBJECT
        if estimate.status in OF_STATUS:
            return OF_STATUS[estimate.status]
        if not estimate.contacts:
            return Why.UNTOUCHED
        if not estimate.p >= LEAST_P:
            return Why.VAGUE
        places = np.array([estimate.map, estimate.mean])[:, :2]
        is_inside = np.abs(places - self._centre_m).max() <= self._half_width_m + self._reach_m
        return Why.VALID if is_inside else Why.OUTSIDE

    def sentence(self, why: Why, estimate: Estimate, fact: str = "") -> str:
        """The reason, its cure, and a fact where there is one."""
        if why is Why.INCONSISTENT:
            fact = ", ".join(f"{name} {p:.0%}" for name, p in estimate.hypotheses._asdict().items())
        elif why is Why.VAGUE:
            fact = f"it is {estimate.p:.1%}"
        elif why is Why.OUTSIDE:
            (x, y, _), (x0, y0) = estimate.map, self._centre_m
            square = f"[{x0:g}, {y0:g}] ± {self._half_width_m:g} m"
            fact = f"it seems to be at x {x:.3f} m, y {y:.3f} m; these are {square}"
        return f"{CURES[why]} ({fact})" if fact else CURES[why]

    def _of_inputs(self, now_s: float | None) -> Why:
        """VALID where a link works, else the reason of the link that is nearest to it."""
        whys = self.of_links(now_s)
        return Why.VALID if Why.VALID in whys else max(whys)
