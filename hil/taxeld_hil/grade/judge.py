"""A run as a subscriber sees it, graded as it goes: what misleads, flags, recoveries, ages.

Memory is bounded, so that a day can be judged as well as a minute.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Status
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.pipeline.freshness import Why
from taxeld_hil import integrity
from taxeld_hil.grade import flags
from taxeld_hil.grade.flags import Flag, Health, TaxelsOf
from taxeld_hil.rig.rig import SETTLE_S
from taxeld_hil.scenario.scenario import Fault, Scenario

SILENCE_S = 0.1  # without an estimate for so long, the stream is silent
USABLE = (Why.VALID, Why.UNTOUCHED, Why.VAGUE)  # the daemon works, whatever it knows
DOUBTS = (Status.INCONSISTENT, Status.BLIND)
STOPPED = (Status.STARTING, Status.STALE)
AGE_UNIT_S = 1e-4
EPISODES_KEPT = 100


class Sample(NamedTuple):
    """An estimate as it was received."""

    t: float  # scenario time
    status: Status
    why: Why
    contacts: int
    map: Poses  # (3,)
    p: float
    radius_m: float
    scan_t: float  # time of its scan, by whatever clock; 0: there was none yet
    age_s: float  # age of the scan [s]
    total_us: float = 0.0  # time that the tick took
    object: int = 0  # number of the object, of those that the daemon knows
    links: tuple[Why, ...] = ()  # of several links: why each one's scans are of no use

    def is_lost(self, link: int) -> bool:
        """Whether one of several links does not work, whatever the others do."""
        return bool(self.links) and self.links[link] is not Why.VALID

    @property
    def valid(self) -> bool:
        return self.why is Why.VALID

    @property
    def claimed(self) -> float:
        """Its `p`; 0 where it is not valid."""
        return self.p if self.valid else 0.0


@dataclass(slots=True)
class Seen:
    """Signs of one fault so far."""

    fault: Fault
    flag: Flag | None
    injected: bool = True
    detected_s: float | None = None  # after its beginning
    recovered_s: float | None = None  # after its end, to a usable estimate that no stop follows
    close_s: float = 0.0  # until when it may recover
    doubted: bool = False  # at the end of its time the status was INCONSISTENT or BLIND
    overlapped: bool = False  # another fault was not over, or began before the recovery
    taxels: tuple[int, ...] = ()
    before: Health | None = None  # the last health without it
    usable_s: float | None = None  # after its end: the first usable estimate that no stop follows
    # after its end: the last health that lists its taxels, or the killed subscriber's first line
    listed_s: float = 0.0

    @property
    def recovery_s(self) -> float | None:
        """How long after its end it had recovered, as far as is known now; None: it has not."""
        if self.usable_s is None or (self.fault.kind == "subscriber_dead" and not self.listed_s):
            return None
        return max(self.usable_s, self.listed_s)


@dataclass(slots=True)
class Tally:
    """Counts over all estimates."""

    estimates: int = 0
    valid: int = 0
    sure: int = 0
    misleading: int = 0
    misleading_episodes: int = 0  # uninterrupted sequences of misleading estimates
    misleading_at_s: list[float] = field(default_factory=list)  # when the first episodes began
    worst_misleading_mm: float = 0.0
    # ages of each scan's first estimate [AGE_UNIT_S] and the times of those ticks [us], with counts
    ages: Counter[int] = field(default_factory=Counter)
    ticks_us: Counter[int] = field(default_factory=Counter)


class Judge:
    """Follows one run."""

    def __init__(
        self,
        scenario: Scenario,
        scene: Scene,
        truth: Poses | None,
        not_injected: tuple[str, ...],
        taxels_of: TaxelsOf,
    ) -> None:
        """`truth` (3,) where it is known; `not_injected`: kinds that this run cannot do."""
        self.scenario = scenario
        self.truth = truth
        self.tally = Tally()
        self.last: Sample | None = None
        self.health: Health | None = None
        self.seen: list[Seen] = []
        known = scenario.known
        # number of the touched object; -1 where the daemon does not know it
        self.object = known.index(scenario.bundle) if scenario.bundle in known else -1
        self._scene = scene
        self._live: list[Seen] = []
        self._todo = [
            Seen(
                fault,
                flags.flag_of(fault, scenario.transport),
                fault.kind not in not_injected,
                close_s=_close_s(fault, scenario),
                overlapped=_is_overlapped(fault, scenario),
                taxels=tuple(taxels_of(fault)),
            )
            for fault in sorted(scenario.fault, key=lambda fault: fault.at_s)
        ]
        self._error: tuple[bytes, float] = b"", np.nan
        self._misled = False

    def error_mm(self, pose: Poses) -> float:
        """Symmetry-aware ADD [mm] of a pose (3,); not a number without a truth."""
        if self.truth is None:
            return float("nan")
        at = np.asarray(pose).tobytes()
        if at != self._error[0]:  # the same pose is published for many ticks
            self._error = at, 1e3 * add_m(self._scene, np.asarray(pose), self.truth)[1]
        return self._error[1]

    def on_estimate(self, sample: Sample) -> None:
        tally, last = self.tally, self.last
        tally.estimates += 1
        tally.valid += sample.valid
        if sample.scan_t and (last is None or sample.scan_t != last.scan_t):
            tally.ages[round(sample.age_s / AGE_UNIT_S)] += 1
            tally.ticks_us[round(sample.total_us)] += 1
        if self.truth is not None:
            self._count(sample)
        if self._todo or self._live:
            self._advance(sample.t)
            for seen in self._live:
                self._look(seen, sample, last)
        self.last = sample

    def on_health(self, t: float, health: Health) -> None:
        self._advance(t)
        for seen in self._live:
            flag, fault = seen.flag, seen.fault
            if flag is None:
                continue
            own = flags.of_link(health, fault.link) or {}
            listed = flags.lists(flag, own, seen.taxels)
            before = flags.of_link(seen.before, fault.link)
            if seen.detected_s is None and (listed or flags.grew(flag, before, own)):
                seen.detected_s = t - fault.at_s
            if listed and t > fault.end_s:
                seen.listed_s = t - fault.end_s
        self.health = health

    def came_back(self, kind: str, t: float) -> None:
        """The process that a fault of this kind had killed works again."""
        for seen in self._live:
            if seen.fault.kind == kind and t > seen.fault.end_s and not seen.listed_s:
                seen.listed_s = t - seen.fault.end_s

    def has_recovered(self, t: float) -> bool:
        """Whether all faults are over, and the daemon usable since, for SETTLE_S at least."""
        return not self._todo and all(
            seen.recovery_s is not None and t - seen.fault.end_s > seen.recovery_s + SETTLE_S
            for seen in self._live
        )

    def end(self, t: float) -> None:
        """The run is over."""
        self._advance(t)
        for seen in self._live:
            self._close(seen)
        self._live = []

    def _advance(self, t: float) -> None:
        """Follow the faults that have begun, and close those whose time to recover is over."""
        while self._todo and self._todo[0].fault.at_s <= t:
            seen = self._todo.pop(0)
            seen.before = self.health
            self._live.append(seen)
            self.seen.append(seen)
        for seen in [s for s in self._live if s.close_s <= t]:
            self._live.remove(seen)
            self._close(seen)

    def _look(self, seen: Seen, sample: Sample, last: Sample | None) -> None:
        fault, flag = seen.fault, seen.flag
        if seen.detected_s is None and flag is not None:
            is_lost = Status.STALE.name in flag.status and sample.is_lost(fault.link)
            if is_lost or sample.status.name in flag.status:
                seen.detected_s = sample.t - fault.at_s
            elif flag.silence and last is not None and sample.t - last.t > SILENCE_S:
                seen.detected_s = max(0.0, last.t + SILENCE_S - fault.at_s)
        if sample.t < fault.end_s:
            return
        if sample.status in STOPPED or sample.is_lost(fault.link):
            seen.usable_s = None
        elif seen.usable_s is None and sample.why in USABLE:
            seen.usable_s = sample.t - fault.end_s

    def _close(self, seen: Seen) -> None:
        seen.before = None
        if seen.usable_s is None:
            seen.doubted = self.last is not None and self.last.status in DOUBTS
            seen.overlapped |= seen.close_s < seen.fault.end_s + _window_s(self.scenario)
            return
        if not seen.overlapped:
            seen.recovered_s = seen.recovery_s

    def _count(self, sample: Sample) -> None:
        tally, misled = self.tally, False
        if integrity.is_sure(sample.claimed):
            tally.sure += 1
            right = sample.object == self.object
            error_mm = self.error_mm(sample.map) if right else np.nan
            misled = bool(integrity.is_misleading(sample.p, error_mm, 1e3 * sample.radius_m))
        if misled:
            tally.misleading += 1
            tally.worst_misleading_mm = max(tally.worst_misleading_mm, self.error_mm(sample.map))
        if misled and not self._misled:
            tally.misleading_episodes += 1
            tally.misleading_at_s.append(sample.t)
            del tally.misleading_at_s[EPISODES_KEPT:]
        self._misled = misled


def _window_s(scenario: Scenario) -> float:
    return scenario.expect.recovery_s + SETTLE_S


def _close_s(fault: Fault, scenario: Scenario) -> float:
    """End of the time to recover: at the latest the begin of another fault."""
    later = [other.at_s for other in scenario.fault if other.at_s >= fault.end_s]
    return min([fault.end_s + _window_s(scenario), *later])


def _is_overlapped(fault: Fault, scenario: Scenario) -> bool:
    """Whether another fault that stops the estimates is on when this one ends."""
    return any(
        other.at_s < fault.end_s < other.end_s
        for other in scenario.fault
        if other.kind in flags.STOPPING
    )


def percentile(counts: Counter[int], share: float) -> float:
    """The value below which so much of the counts lies, in their unit; 0 of none."""
    total, seen = sum(counts.values()), 0
    for value in sorted(counts):
        seen += counts[value]
        if seen >= share * total:
            return float(value)
    return 0.0
