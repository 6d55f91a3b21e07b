"""Outcomes of scans: the result of each, and counts of scans that were not used."""

from dataclasses import dataclass, replace
from typing import TypeVar

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Estimate
from taxeld.model.observation import Activation
from taxeld.skin.state import SkinState
from taxeld_protocol.decoder import Scan

Dated = TypeVar("Dated", Scan, Activation, Estimate, SkinState)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one scan, and the time that each stage took [ns]."""

    estimate: Estimate
    activation: Activation | None = None  # None: baseline not known, or scan not used
    sensor: Poses | None = None  # (3,) sensor's pose in the world; None where not known
    skin_ns: int = 0
    propose_ns: int = 0
    filter_ns: int = 0
    link: int = 0  # number of the link whose scan it was

    @property
    def is_used(self) -> bool:
        """Whether the estimator has taken the scan."""
        return self.sensor is not None


@dataclass(slots=True)
class InputCounters:
    """Counters of the inputs, since start."""

    scans_old: int = 0  # scans older than their limit when they arrived, not used
    scans_from_the_future: int = 0  # scans later than now, or without a time, not used
    scans_without_pose: int = 0  # scans without a sensor pose near in time, not used
    scans_waited: int = 0  # scans that waited for a pose at or after their time
    clock_steps: int = 0  # steps of the Unix clock


def later(dated: Dated, by: float) -> Dated:
    """The same at a time that is later by `by` seconds."""
    return replace(dated, t=dated.t + by) if by else dated
