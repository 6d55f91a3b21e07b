"""How a daemon must show each kind of fault, and how soon.

Frames have neither number nor time of sending, and a pose is all that is known of the robot. So
these have no flag: packets that come twice on the native link, a bus that is late as a whole, and
wrong poses at right times.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from taxeld.config.tables import SensorPoseConfig
from taxeld.pipeline import poses, stage
from taxeld_hil.scenario.scenario import Fault

HEALTH_S = 1.5  # /taxeld/health comes once a second
STALE_S = stage.SCAN_AGE_S + 0.15  # with a scan's period, and a tick
POSE_STALE_S = poses.AGE_S + SensorPoseConfig().wait_s + 0.15
STUCK_S = 12.5  # 200 scans without a count of change, a slice of a second, and a health message
JUMP_S = 4.0  # found when the sensor moves on, or by readings under the baseline

Health = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Flag:
    """Signs of a fault; one of them is enough."""

    within_s: float
    counters: tuple[str, ...] = ()  # counters of /taxeld/health that grow
    taxels: str = ""  # list in /taxeld/health that names the taxels
    status: tuple[str, ...] = ()  # statuses of /taxeld/estimate
    silence: bool = False  # no estimates at all

    @property
    def text(self) -> str:
        names = [f"status {name}" for name in self.status]
        names += ["no estimates"] if self.silence else []
        return ", ".join([*names, *self.counters, *([self.taxels] if self.taxels else [])])


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


def flag_of(fault: Fault, transport: str) -> Flag | None:
    """How a daemon on this transport must show a fault; None: it cannot be detected, or is over
    before it must be."""
    flag = _flag(fault, transport)
    lasting = flag is not None and (flag.taxels or fault.kind == "baseline_jump")
    return None if lasting and flag is not None and fault.for_s < flag.within_s else flag


def _flag(fault: Fault, transport: str) -> Flag | None:
    line = transport == "native"
    match fault.kind:
        case "dropped":
            return Flag(HEALTH_S, (*BROKEN, "source.missed"))
        case "corrupted":
            return Flag(HEALTH_S, BROKEN[:2])
        case "duplicated" | "reordered" if not line:
            return Flag(HEALTH_S, BROKEN)
        case "late" if fault.share < 1.0 and not line:
            return Flag(HEALTH_S, (*BROKEN, "source.missed"))
        case "flooded":
            return Flag(HEALTH_S, BROKEN[:2] if line else ("source.dropped.foreign",))
        case "module_dead":
            return Flag(HEALTH_S, taxels="dead_taxels")
        case "taxel_stuck":
            return Flag(STUCK_S, ("estimator.stuck",), "stuck_taxels")
        case "saturated":
            return Flag(HEALTH_S, taxels="saturated_taxels")
        case "baseline_jump":
            counters = ("estimator.stuck", "skin.lowered")
            return Flag(JUMP_S, counters, status=("INCONSISTENT",))
        case "reboot" | "unplugged":
            return Flag(STALE_S, status=("STALE",))
        case "adapter_closed" if transport == "slcan":
            return Flag(STALE_S, status=("STALE",))
        case "pose_silent":
            return Flag(POSE_STALE_S, status=("STALE",))
        case "pose_late" if fault.delay_s > POSE_STALE_S:
            return Flag(POSE_STALE_S, status=("STALE",))
        case "pose_jumping":
            return Flag(HEALTH_S, ("estimator.jumps",), status=("INCONSISTENT",))
        case "daemon_killed":
            return Flag(0.5, silence=True)
    return None


def value(health: Health, path: str) -> int:
    """A counter by its path; 0 where the health has none such."""
    found: Any = health
    for name in path.split("."):
        found = found.get(name, {}) if isinstance(found, dict) else {}
    return int(found) if isinstance(found, (int, float)) else 0


def of_link(health: Health | None, link: int) -> Health | None:
    """The health of a link."""
    if health is None or not link:
        return health
    return {"uptime_s": health["uptime_s"], **[*health["links"].values()][link]}


def grew(flag: Flag, before: Health | None, now: Health) -> bool:
    """Whether one of the flag's counters is higher than before."""
    base = before if before is not None and before["uptime_s"] <= now["uptime_s"] else {}
    return any(value(now, name) > value(base, name) for name in flag.counters)


def lists(flag: Flag, health: Health, taxels: Iterable[int]) -> bool:
    """Whether the flag's list names all the taxels."""
    return bool(flag.taxels) and set(taxels) <= set(health.get(flag.taxels, ()))


TaxelsOf = Callable[[Fault], list[int]]
