"""How a daemon must show each kind of fault, how soon, and what a run's subscriber saw of it.

Frames have neither number nor time of sending, and a pose is all that is known of the robot. So
these have no flag: packets that come twice on the native link, a bus that is late as a whole, and
wrong poses at right times.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from taxeld.config.tables import SensorPoseConfig
from taxeld.estimator.estimate import Status
from taxeld.pipeline import poses, stage
from taxeld.pipeline.freshness import Why
from taxeld_hil.grade.session import Health, Reception, Run
from taxeld_hil.rig.rig import SETTLE_S
from taxeld_hil.scenario.scenario import Fault

HEALTH_S = 1.5  # /taxeld/health comes once a second
STALE_S = stage.SCAN_AGE_S + 0.15  # with a scan's period, and a tick
POSE_STALE_S = poses.AGE_S + SensorPoseConfig().wait_s + 0.15
STUCK_S = 12.5  # 200 scans without a count of change, a slice of a second, and a health message
JUMP_S = 4.0  # found when the sensor moves on, or by readings under the baseline
SILENCE_S = 0.1  # without an estimate for so long, the stream is silent
USABLE = (Why.VALID, Why.UNTOUCHED, Why.VAGUE)  # the daemon works, whatever it knows
DOUBTS = (Status.INCONSISTENT, Status.BLIND)
STOPPED = (Status.STARTING, Status.STALE)
STOPPING = (
    "reboot",
    "unplugged",
    "adapter_closed",
    "daemon_killed",
    "pose_silent",
    "pose_late",
    "pose_frozen",
    "pose_jumping",
    "baseline_jump",
)  # while these are on, and shortly after, estimates may stop
BROKEN = ("source.crc_errors", "source.length_errors", "source.dropped.orphan")


class Flag(NamedTuple):
    """Signs of a fault; one of them is enough."""

    within_s: float
    counters: tuple[str, ...] = ()  # counters of /taxeld/health that grow
    taxels: str = ""  # list in /taxeld/health that names the taxels
    status: tuple[Status, ...] = ()  # statuses of /taxeld/estimate
    silence: bool = False  # no estimates at all

    @property
    def text(self) -> str:
        names = [f"status {status.name}" for status in self.status]
        names += ["no estimates"] * self.silence
        return ", ".join([*names, *self.counters, *filter(None, [self.taxels])])


STALE, DOUBT = (Status.STALE,), (Status.INCONSISTENT,)
FLAGS = {
    "dropped": Flag(HEALTH_S, (*BROKEN, "source.missed")),
    "corrupted": Flag(HEALTH_S, BROKEN[:2]),
    "duplicated": Flag(HEALTH_S, BROKEN),
    "reordered": Flag(HEALTH_S, BROKEN),
    "late": Flag(HEALTH_S, (*BROKEN, "source.missed")),
    "flooded": Flag(HEALTH_S, ("source.dropped.foreign",)),
    "module_dead": Flag(HEALTH_S, taxels="dead_taxels"),
    "taxel_stuck": Flag(STUCK_S, ("estimator.stuck",), "stuck_taxels"),
    "saturated": Flag(HEALTH_S, taxels="saturated_taxels"),
    "baseline_jump": Flag(JUMP_S, ("estimator.stuck", "skin.lowered"), status=DOUBT),
    "reboot": Flag(STALE_S, status=STALE),
    "unplugged": Flag(STALE_S, status=STALE),
    "adapter_closed": Flag(STALE_S, status=STALE),
    "pose_silent": Flag(POSE_STALE_S, status=STALE),
    "pose_late": Flag(POSE_STALE_S, status=STALE),
    "pose_jumping": Flag(HEALTH_S, ("estimator.jumps",), status=DOUBT),
    "daemon_killed": Flag(0.5, silence=True),
}
ON_LINE = {"flooded": FLAGS["corrupted"], "duplicated": None, "reordered": None, "late": None}


def flag_of(fault: Fault, transport: str) -> Flag | None:
    """How a daemon on this transport must show a fault; None: it cannot be detected, or is over
    before it must be."""
    flag = FLAGS.get(fault.kind)
    if transport == "native":
        flag = ON_LINE.get(fault.kind, flag)
    hidden = {
        "late": fault.share >= 1.0,
        "adapter_closed": transport != "slcan",
        "pose_late": fault.delay_s <= POSE_STALE_S,
        # these must last
        "baseline_jump": fault.for_s < JUMP_S,
        **dict.fromkeys(("module_dead", "saturated"), fault.for_s < HEALTH_S),
        "taxel_stuck": fault.for_s < STUCK_S,
    }
    return None if hidden.get(fault.kind) else flag


def value(health: Health, path: str) -> int:
    """A counter by its path; 0 where the health has none such."""
    found: Any = health
    for name in path.split("."):
        found = found.get(name, {}) if isinstance(found, dict) else {}
    return int(found) if isinstance(found, (int, float)) else 0


def grew(flag: Flag, before: Health, now: Health) -> bool:
    """Whether one of the flag's counters is higher than `before`, in this life of the daemon."""
    base = before if before and before["uptime_s"] <= now["uptime_s"] else {}
    return any(value(now, name) > value(base, name) for name in flag.counters)


def signs(run: Run, got: Reception) -> list[dict[str, Any]]:
    """What was seen of each fault that began, in the order of their beginning: its flag, and
    whether it was `injected`; when it was `detected_s` after its beginning, and `recovered_s` after
    its end, to a usable estimate that no stop follows; whether at the end of its time the daemon
    `doubted` the object; and whether it was `overlapped`: another fault was not over, or began
    before the recovery."""
    faults = zip(run.scenario.fault, run.taxels, strict=True)
    begun = sorted(faults, key=lambda pair: pair[0].at_s)
    return [_signs(run, got, *pair) for pair in begun if pair[0].at_s <= run.end_s]


def _signs(run: Run, got: Reception, fault: Fault, taxels: Sequence[int]) -> dict[str, Any]:
    scenario, e, t = run.scenario, got.estimates, got.estimates.at
    flag = flag_of(fault, scenario.transport)
    # the time to recover ends at the latest when another fault begins
    window_s = scenario.expect.recovery_s + SETTLE_S
    later = [other.at_s for other in scenario.fault if other.at_s >= fault.end_s]
    close_s = min([fault.end_s + window_s, *later])
    within = (t >= fault.at_s) & (t < close_s)
    lost = got.lost(fault.link)
    listed = list(_listed(flag, fault, taxels, got, close_s))
    shown = [at for at, _ in listed]
    if flag is not None:
        is_shown = np.isin(e.status, flag.status) | (lost & (Status.STALE in flag.status))
        shown += t[within & is_shown][:1].tolist()
        gaps = np.flatnonzero(within[1:] & (np.diff(t) > SILENCE_S))[:1]
        shown += np.maximum(t[gaps] + SILENCE_S, fault.at_s).tolist() if flag.silence else []
    # back to what can be used, with all that it had lost
    stopped = lost | np.isin(e.status, STOPPED)
    after = within & (t >= fault.end_s)
    last_stop_s = t[after & stopped].max(initial=-np.inf)
    usable = t[after & ~stopped & (t > last_stop_s) & np.isin(e.why, USABLE)][:1].tolist()
    back = [at for at, in_list in listed if in_list and at > fault.end_s][-1:]
    stops = (other for other in scenario.fault if other.kind in STOPPING)
    overlapped = any(other.at_s < fault.end_s < other.end_s for other in stops)
    return {
        "kind": fault.kind,
        "at_s": fault.at_s,
        "for_s": fault.for_s,
        "flag": flag.text if flag else None,
        "within_s": flag.within_s if flag else None,
        "injected": fault.kind not in run.not_injected,
        "detected_s": min(shown) - fault.at_s if shown else None,
        "recovered_s": max(usable + back) - fault.end_s if usable and not overlapped else None,
        "doubted": bool(not usable and np.isin(e.status[t < close_s][-1:], DOUBTS).any()),
        "overlapped": overlapped or (not usable and close_s < fault.end_s + window_s),
    }


def _listed(
    flag: Flag | None, fault: Fault, taxels: Iterable[int], got: Reception, close_s: float
) -> Iterator[tuple[float, bool]]:
    """The times of those messages of health that show a fault, and whether they list its taxels."""
    before: Health = {}
    for at, whole in got.health if flag else ():
        health = whole
        if fault.link:
            of_link = [*whole["links"].values()][fault.link]
            health = {"uptime_s": whole["uptime_s"], **of_link}
        if at < fault.at_s:
            before = health
        elif flag and at < close_s:
            listed = bool(flag.taxels) and set(taxels) <= set(health.get(flag.taxels, ()))
            if listed or grew(flag, before, health):
                yield at, listed
