"""The learned state of a skin, to be kept while the daemon is not running.

A stored baseline is used when the first scan after the restart confirms it: at least half of the
taxels that answer read within their thresholds of it. So a touch held over the restart is noticed
at once, and a skin that has drifted too far, or is another one, is captured anew.
"""

import hashlib
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.layout.layout import Layout

RESPONSE = "gain", "onset", "log_sag", "gain_sd", "onset_sd", "log_sag_sd"  # as `SkinFit.values`
CONFIRMING = 0.5  # share of answering taxels that must read within their thresholds


@dataclass(frozen=True, slots=True)
class SkinState:
    """State of M taxels and K modules at Unix time t [s]."""

    t: float
    digest: str  # digest of the taxels' places and UIDs
    baseline: Floats  # (M,) counts, nan where not known
    noise: Floats  # (M,) counts
    coefficient: Floats  # (K,) counts of drift a count of T0
    leak: Floats  # (K,) counts of T0 a count of press: the part of a press that T0 reads
    t0: Floats  # (K,) counts, nan where there is none
    full_scale: float  # counts at full depth of a gain of 1, to which the responses belong
    calibrated_t: float  # time of the calibration from which they were learned; 0 without one
    gain: Floats  # (M,) of each taxel's response (`skin.fit`), and so on
    onset: Floats
    log_sag: Floats  # logarithm of its length [m]
    gain_sd: Floats
    onset_sd: Floats
    log_sag_sd: Floats


def digest(layout: Layout) -> str:
    """16 hex digits that identify the taxels' places and UIDs."""
    text = layout.digest.encode() + layout.uid.astype("<i8").tobytes()
    return hashlib.sha256(text).hexdigest()[:16]


def is_confirmed(over: Floats, threshold: Floats, answered: Bools) -> bool:
    """Whether stored baselines hold. `over` (M,): counts over them; `threshold` (M,) [counts];
    `answered` (M,): taxels that answered."""
    return bool((np.abs(over[answered]) <= threshold[answered]).mean() >= CONFIRMING)
