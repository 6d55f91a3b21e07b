"""The table `[mesh]` of a scenario: a skin that is not the estimator's own model of it.

Where a figure is not measured on such a skin, its comment says that it is assumed.
"""

from dataclasses import dataclass

from taxeld.config.toml_tables import between, key


@dataclass(frozen=True, slots=True)
class MeshConfig:
    """With `physics = "mesh"`; an effect is off at 0."""

    taxel_radius_m: float = key(
        0.002, between(0, 0.02), "of an electrode, over which a taxel reads the mean"
    )
    sag_m: float = key(0.003, between(0, 0.02), "the cover sags by 1/e so far beside a press")
    # a plate condenser whose gap closes by this share at full scale: assumed. What is known of such
    # skin is a nearly linear response above 0.5 bar
    closing: float = key(0.2, between(0, 0.9), "of the gap at full scale; 0 is a linear response")
    hysteresis: float = key(0.1, between(0, 1), "more is read while a press recedes")  # assumed
    creep: float = key(0.1, between(0, 1), "of a long press stays behind and recovers")  # assumed
    creep_s: float = key(2.0, between(0.01, 1000), "time constant of that")  # assumed
    # Jamali et al. 2015 found none on a capacitive fingertip: less than could be measured there
    cross_talk: float = key(
        0.01, between(0, 0.2), "of a difference, between neighbours of a module"
    )
    # "a few counts a minute", measured
    drift_counts_per_min: float = key(3.0, between(0, 1000), "fastest, of T0 and taxels alike")
    drift_period_s: float = key(3600.0, between(1, 1e6), "of the temperature's waves")
    drift_cv: float = key(0.3, between(0, 2), "spread of the taxels' share in it")  # assumed
