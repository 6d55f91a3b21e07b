"""What becomes of scans: what each led to, and what was not used."""

from dataclasses import dataclass, replace
from typing import TypeVar

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Estimate
from taxeld.model.activation import Activation
from taxeld.skin.state import SkinState
from taxeld_protocol.decoder import Scan

Dated = TypeVar("Dated", Scan, Activation, Estimate, SkinState)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one scan led to, and the time each stage took [ns]."""

    estimate: Estimate
    activation: Activation | None = None  # None while the baseline is learned, or not used
    sensor: Poses | None = None  # (3,) in the world; None where it is not known
    skin_ns: int = 0
    propose_ns: int = 0
    filter_ns: int = 0
    is_afterthought: bool = False  # it was told before, and may have been bettered since

    @property
    def is_used(self) -> bool:
        """Whether the estimator has taken the scan."""
        return self.sensor is not None


@dataclass(slots=True)
class InputCounters:
    """Since start."""

    scans_old: int = 0  # that arrived when older than their limit, not used
    scans_from_the_future: int = 0  # later than now, or of no time at all, not used
    scans_without_pose: int = 0  # for which no sensor pose near in time came, not used
    scans_waited: int = 0  # for a pose at or after their time
    scans_put_off: int = 0  # to the next tick, as the time of this one was up
    scans_crowded_out: int = 0  # by too many that waited, not used
    clock_steps: int = 0  # of the Unix clock


def later(dated: Dated, by: float) -> Dated:
    """The same, of a time that is later by so much."""
    return replace(dated, t=dated.t + by) if by else dated
