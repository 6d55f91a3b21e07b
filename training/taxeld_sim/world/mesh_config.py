"""The table `[mesh]` of a scenario: a soft skin that is not the estimator's own model of it.

Three skins have a name; a scenario's `[mesh]` replaces single keys of the one that it names. What a
taxel, a pair of them or a press draws for itself is given as [median, 90th percentile] of a
lognormal. docs/physics.md says what each figure rests on; what is assumed says so here.
"""

from dataclasses import dataclass, replace
from typing import TypeAlias

from taxeld.config.gate import Bound, between, key

Pair: TypeAlias = tuple[float, float]  # the median, and the 90th percentile


def spread(most: float) -> Bound:
    """A Pair whose median is no more than its 90th percentile, and that is no more than `most`."""

    def fault(pair: Pair) -> str | None:
        median, p90 = pair
        if not 0.0 <= median <= p90 <= most:
            return f"must be [median, 90th percentile], rising, 0..{most:g}, not {list(pair)}"
        return "must be [0, 0] or of a median over 0" if median == 0.0 < p90 else None

    return fault


@dataclass(frozen=True, slots=True)
class MeshConfig:
    """A skin; an effect is off at 0, or at [0, 0]. The defaults are those of `typical`."""

    taxel_radius_m: float = key(
        0.002, between(0, 0.02), "of an electrode, over which a taxel reads the mean"
    )
    # a fingertip, 2 mm deep, then leaves a taxel 12 mm away under 1 % of its peak, and in one press
    # of ten 15 %
    sag_m: tuple[float, float] = key(
        (0.0019, 0.006), spread(0.02), "the cover sags by 1/e so far beside a press"
    )
    bend: float = key(0.065, between(-0.9, 0.9), "the response is h + bend·h(1 − h) on average")
    onset: tuple[float, float] = key(
        (0.85, 2.8), spread(10), "how much steeper a taxel's own response begins"
    )
    hysteresis: tuple[float, float] = key(
        (0.015, 0.032), spread(1), "of full: more is read in a press's retreat"
    )
    residue: tuple[float, float] = key(
        (0.012, 0.03), spread(1), "of a press that stays, and is soon gone"
    )
    residue_s: float = key(1.0, between(0.01, 1000), "time constant of that")
    residue_slow: tuple[float, float] = key(
        (0.008, 0.075), spread(1), "of a press that stays, and is long felt"
    )
    residue_slow_s: float = key(30.0, between(0.01, 10_000), "time constant of that")
    loading_s: float = key(0.5, between(0.01, 100), "of a press, until that much stays")  # assumed
    gain_cv: float = key(0.15, between(0, 1), "spread of the taxels' gains")
    cross_talk: tuple[float, float] = key(
        (0.01, 0.08), spread(0.5), "of a press, read by each other taxel of its module"
    )
    noise_counts: tuple[float, float] = key((24.0, 43.0), spread(1000), "sd of a reading")
    # "a few counts a minute", measured
    drift_counts_per_min: float = key(3.0, between(0, 1000), "fastest, of T0 and taxels alike")
    drift_period_s: float = key(3600.0, between(1, 1e6), "of the temperature's waves")
    drift_cv: float = key(0.3, between(0, 2), "spread of the taxels' share in it")  # assumed


TYPICAL = MeshConfig()
POOR = replace(
    TYPICAL,
    sag_m=(0.0048, 0.0048),
    onset=(0.85, 3.2),
    hysteresis=(0.032, 0.032),
    residue=(0.025, 0.025),
    residue_slow=(0.075, 0.075),
    gain_cv=0.19,
    cross_talk=(0.03, 0.03),  # the mean: a 90th percentile is not known
    noise_counts=(90.0, 90.0),
)
STIFF = replace(  # assumed: what a thin, hard cover could do
    TYPICAL,
    sag_m=(0.0008, 0.0012),
    onset=(1.0, 1.2),
    hysteresis=(0.003, 0.005),
    residue=(0.002, 0.004),
    residue_slow=(0.001, 0.002),
    gain_cv=0.13,
    cross_talk=(0.002, 0.005),
    noise_counts=(0.56, 0.56),
)
# every effect off: what the estimator takes a taxel for, with the noise and gains that it assumes
PLAIN = MeshConfig(
    taxel_radius_m=0.0,
    sag_m=(0.0, 0.0),
    bend=0.0,
    onset=(1.0, 1.0),
    hysteresis=(0.0, 0.0),
    residue=(0.0, 0.0),
    residue_slow=(0.0, 0.0),
    gain_cv=0.17,
    cross_talk=(0.0, 0.0),
    noise_counts=(34.0, 34.0),
    drift_counts_per_min=0.0,
)
SKINS = {"typical": TYPICAL, "poor": POOR, "stiff": STIFF}
FOAMS = ("scene", *SKINS)  # `scene` is the estimator's own model
