"""Counters of the estimator, since start."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class RuleCounters:
    """Counters of the way the belief learns."""

    impossible: int = 0  # scans that made every pose impossible: the belief began anew
    inconsistent: int = 0  # scans that no pose explained
    forgotten: int = 0  # times that the past was dropped: the object had moved


@dataclass(slots=True)
class EstimatorCounters:
    """Counters of scans and their use."""

    scans: int = 0
    updates: int = 0  # scans that were learned from
    injections: int = 0
    thoughts: int = 0  # injections by second opinions while there was nothing to learn
    bad_input: int = 0  # scans with values that are not finite
    out_of_range: int = 0  # scans with activations beyond 0..1, which were clipped
    back_in_time: int = 0  # scans older than the one before, not used
    jumps: int = 0  # scans whose sensor pose is too far from the last, not used
    stuck: int = 0  # scans in which a taxel read the same as ever, and was left out
    blind: int = 0  # scans without a live taxel, or without one where contact is expected
    rule: RuleCounters = field(default_factory=RuleCounters)
