"""Where an operator, a camera or a planner says that the object is. Never the truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from taxeld.config import gate
from taxeld.config.gate import between, key

LEAST_SD, MOST_SD = (5e-4, 5e-4, 5e-3), 10.0  # m, m, rad
NAME_MAX = 64  # characters of an object's name

Row = tuple[float, float, float]


def _cov(cov: tuple[Row, ...]) -> str | None:
    sd = [math.sqrt(max(cov[i][i], 0.0)) for i in range(3)]
    if not all(0.999 * lo <= s <= 1.001 * MOST_SD for s, lo in zip(sd, LEAST_SD, strict=True)):
        return "standard deviations: from 0.5 mm and 0.005 rad to 10 m and 10 rad"
    (_, a, b), (d, _, c), (e, f, _) = (
        [cov[i][j] / (sd[i] * sd[j]) for j in range(3)] for i in range(3)
    )
    is_symmetric = max(abs(a - d), abs(b - e), abs(c - f)) < 1e-6
    is_positive = abs(a) < 1.0 and 1.0 + 2.0 * a * b * c - a * a - b * b - c * c > 1e-6
    return None if is_symmetric and is_positive else "is not symmetric and positive definite"


@dataclass(frozen=True, slots=True, kw_only=True)
class PosePrior:
    """Where the object is said to be, in the world."""

    x: float = key(check=between(-10, 10, "m"))
    y: float = key(check=between(-10, 10, "m"))
    # None: not known; x and y are then of the middle of the object
    theta: float | None = key(None, between(-9.5, 9.5, "rad"))
    cov: tuple[Row, Row, Row] = key(check=_cov)  # of (x, y, θ) [m², m rad, rad²]
    weight: float = key(0.9, between(0.01, 0.95))  # probability that it means this object, here
    object: str = key(  # empty: whichever object it is
        "", lambda name: None if len(name) <= NAME_MAX else f"has more than {NAME_MAX} characters"
    )


def read_prior(message: Mapping[str, Any]) -> PosePrior | str:
    """The prior of a message, whose `cov` may be the 3 standard deviations [m, m, rad]; or the
    reason why it is none."""
    values = {name: value for name, value in message.items() if value is not None}
    sd, faults = values.get("cov"), list[str]()
    if isinstance(sd, list | tuple) and all(type(s) in (int, float) and 0 < s < 1e9 for s in sd):
        values["cov"] = [[s * s * (i == j) for j in range(len(sd))] for i, s in enumerate(sd)]
    made = gate.take(PosePrior, values, faults)
    if made is not None:
        return made
    is_shape = faults[0].startswith(("cov[", "cov: must"))
    return faults[0] + "; give 3 standard deviations, or a matrix of 3 by 3" * is_shape
