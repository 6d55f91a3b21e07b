"""What a skin has learned of itself, to be kept while the daemon is not running: JSON, < 50 kB.

A stored baseline is believed when the first scan after the restart bears it out: at least half of
the taxels that speak read within their thresholds of it, so that a skin that is touched meanwhile
is felt at once, and one that has drifted off, or is another, is captured afresh.
"""

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from taxeld.idle import Bools, Floats
from taxeld.layout import Layout

VERSION = 1
FUTURE_S = 3600.0  # a state from farther ahead was stored by a wrong clock, or is read by one
COUNT_MAX = 0xFFFF
BORNE_OUT = 0.5  # share of the taxels that must read as they did


@dataclass(frozen=True, slots=True)
class SkinState:
    """M taxels and K modules, at Unix time t."""

    t: float
    digest: str  # of the taxels' places and UIDs
    baseline: Floats  # (M,) counts, nan where it is not known
    noise: Floats  # (M,) counts
    coefficient: Floats  # (K,) counts of drift a count of T0
    leak: Floats  # (K,) share of a press that T0 sees
    t0: Floats  # (K,) counts, nan where there is none


def digest(layout: Layout) -> str:
    """16 hex digits that name the places of the taxels and their UIDs."""
    text = layout.digest.encode() + layout.uid.astype("<i8").tobytes()
    return hashlib.sha256(text).hexdigest()[:16]


def dump(state: SkinState) -> bytes:
    """As JSON, in one line."""
    return json.dumps(
        {
            "version": VERSION,
            "t": round(state.t, 3),
            "digest": state.digest,
            "baseline": _list(state.baseline, 2),
            "noise": _list(state.noise, 2),
            "coefficient": _list(state.coefficient, 5),
            "leak": _list(state.leak, 5),
            "t0": _list(state.t0, 2),
        },
        separators=(",", ":"),
        allow_nan=False,
    ).encode()


def parse(text: bytes, digest: str, taxels: int, modules: int) -> SkinState:
    """What `dump` wrote for this very skin.

    Raises:
        ValueError: it is damaged, or of another skin.
    """
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("it is damaged") from None
    if not isinstance(data, dict) or data.get("version") != VERSION:
        raise ValueError(f"it is not of version {VERSION}")
    if data.get("digest") != digest:
        raise ValueError("it is of another skin")
    t = data.get("t")
    if not isinstance(t, int | float) or not math.isfinite(t):
        raise ValueError("its time is damaged")
    return SkinState(
        t=float(t),
        digest=digest,
        baseline=_array(data, "baseline", taxels, 0.0, COUNT_MAX, gaps=True),
        noise=_array(data, "noise", taxels, 0.0, COUNT_MAX),
        coefficient=_array(data, "coefficient", modules, -100.0, 100.0),
        leak=_array(data, "leak", modules, 0.0, 1.0),
        t0=_array(data, "t0", modules, -COUNT_MAX, COUNT_MAX, gaps=True),
    )


def is_borne_out(over: Floats, threshold: Floats, spoke: Bools) -> bool:
    """Whether what taxels read over their stored baselines bears these out."""
    return bool((np.abs(over[spoke]) <= threshold[spoke]).mean() >= BORNE_OUT)


def _list(values: Floats, digits: int) -> list[float | None]:
    rounded = np.round(values, digits).tolist()
    return [None if math.isnan(value) else value for value in rounded]


def _array(
    data: dict[str, Any], name: str, size: int, low: float, high: float, *, gaps: bool = False
) -> Floats:
    """A list of numbers in low..high, null for nan where it may have gaps."""
    values = data.get(name)
    if not isinstance(values, list) or len(values) != size:
        raise ValueError(f"its {name} is damaged")
    for value in values:
        number = isinstance(value, int | float) and low <= value <= high
        if not number and not (gaps and value is None):
            raise ValueError(f"its {name} is damaged")
    return np.array(values, dtype=np.float64)
