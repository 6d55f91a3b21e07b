"""What is known of one skin from before: its calibration, and the state kept over a restart."""

import hashlib
from dataclasses import dataclass

from taxeld.arrays import Bools, Floats, Poses
from taxeld.layout.layout import Layout

DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """Measured values of M taxels; each sd is one standard deviation."""

    t: float
    digest: str  # `skin_digest`
    object: str  # name of the object that was pressed
    presses: int
    full_scale_depth_m: float
    full_scale_counts: float  # counts at that depth of a taxel whose gain is 1
    full_scale_sd: float  # relative sd
    bend: float  # bend of the common response (`model.response`)
    bend_sd: float
    mount: Poses  # (3,) sensor's frame in the frame of the robot's poses
    mount_sd: Floats
    noise_sigma: float  # sd of an activation about the expected one: constant part
    gain_cv: float  # sd of an activation in proportion to it, beside noise_sigma
    gain: Floats  # (M,) relative gain of each taxel
    gain_sd: Floats  # (M,) relative; the fleet's spread for a taxel that was touched too little
    onset: Floats  # (M,) onset of the taxel's own response (`model.response`)
    onset_sd: Floats
    noise_counts: Floats  # (M,) sd of a reading at rest
    frozen: Bools  # (M,) taxels that never changed
    answers: Floats  # (M,) share of the presses that each taxel answers at all


@dataclass(frozen=True, slots=True)
class SkinState:
    """What a skin of M taxels and K modules has learned by Unix time t [s]."""

    t: float
    digest: str  # `skin_digest`
    baseline: Floats  # (M,) counts, nan where not known
    noise: Floats  # (M,) counts
    coefficient: Floats  # (K,) counts of drift a count of T0
    leak: Floats  # (K,) counts of T0 a count of press: the part of a press that T0 reads
    t0: Floats  # (K,) counts, nan where there is none
    full_scale: float  # counts at full depth of a gain of 1, to which the responses belong
    calibrated_t: float  # time of the calibration from which they were learned; 0 without one
    response: Floats  # (8, M) as `SkinFit.values`


def skin_digest(layout: Layout) -> str:
    """16 hex digits that identify the taxels' places and UIDs."""
    text = layout.digest.encode() + layout.uid.astype("<i8").tobytes()
    return hashlib.sha256(text).hexdigest()[:16]
