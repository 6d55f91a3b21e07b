"""Where an operator, a camera or a planner says that the object is. Never the truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

KEYS = ("x", "y", "theta", "cov", "weight", "object")
WEIGHT = 0.9  # probability that a prior means this object, unless it says so
WEIGHTS = 0.01, 0.95  # its bounds: no prior makes an estimate sure by itself
FAR_M = 10.0  # a pose whose |x| or |y| is larger is in a wrong unit
THETA_MAX = 3.0 * math.pi  # beyond it an angle is in degrees
LEAST_SD, MOST_SD = (5e-4, 5e-4, 5e-3), (10.0, 10.0, 10.0)  # m, m, rad
PAIRS = (0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1)  # off the diagonal
NAME_MAX = 64  # characters of an object's name


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Where the object is said to be, in the world."""

    x: float
    y: float
    theta: float  # nan: not known; x and y are then of the middle of the object
    cov: tuple[float, ...]  # 9 numbers of (x, y, θ), row by row [m², m rad, rad²]
    weight: float = WEIGHT  # probability that it means this object, here
    object: str = ""  # name; empty: whichever object it is

    @property
    def fault(self) -> str:
        """Why it cannot be used, with the cure; empty where it can."""
        if not all(map(math.isfinite, (self.x, self.y, *self.cov, self.weight))):
            return "a number is not finite: leave such a prior out"
        if math.isinf(self.theta):
            return "theta is not finite: null is an unknown yaw"
        if max(abs(self.x), abs(self.y)) > FAR_M:
            return f"x or y is beyond {FAR_M:.0f} m: send metres, in the world frame"
        if abs(self.theta) > THETA_MAX:
            return "theta is beyond 1.5 turns: send radians, not degrees"
        if not WEIGHTS[0] <= self.weight <= WEIGHTS[1]:
            return f"weight must be from {WEIGHTS[0]} to {WEIGHTS[1]}: no prior is certain"
        if len(self.object) > NAME_MAX or not self.object.isprintable():
            return f"object is no name of at most {NAME_MAX} characters"
        return _cov_fault(self.cov)


def _cov_fault(cov: Sequence[float]) -> str:
    sd = [math.sqrt(max(value, 0.0)) for value in cov[::4]]
    bounds = zip(sd, LEAST_SD, MOST_SD, strict=True)
    if not all(0.999 * least <= value <= 1.001 * most for value, least, most in bounds):
        return "cov: standard deviations must be from 0.5 mm and 0.005 rad to 10 m and 10 rad"
    a, b, c, d, e, f = (cov[3 * i + j] / (sd[i] * sd[j]) for i, j in PAIRS)
    is_symmetric = max(abs(a - d), abs(b - e), abs(c - f)) < 1e-6
    is_positive = abs(a) < 1.0 and 1.0 + 2.0 * a * b * c - a * a - b * b - c * c > 1e-6
    if not (is_symmetric and is_positive):
        return "cov is not symmetric and positive definite"
    return ""


def read_prior(message: Mapping[str, Any]) -> PosePrior | str:
    """The prior of a message's keys, or the reason why it is none, with the cure."""
    for key in message:
        if key not in KEYS:
            return f"unknown key {key!r:.60}; a prior has {', '.join(KEYS)}"
    for key in ("x", "y", "cov"):
        if key not in message:
            return f"key {key} lacks; a prior has {', '.join(KEYS)}"
    theta, name, weight = message.get("theta"), message.get("object"), message.get("weight")
    numbers = {"x": message["x"], "y": message["y"]}
    numbers |= {"theta": math.nan if theta is None else theta}
    numbers |= {"weight": WEIGHT if weight is None else weight}
    for key, value in numbers.items():
        if type(value) not in (int, float):
            return f"{key} is no number"
    if theta is not None and theta != theta:  # noqa: PLR0124
        return "theta is not finite: null is an unknown yaw"
    if name is not None and not isinstance(name, str):
        return "object is no name"
    cov = _nine(message["cov"])
    if cov is None:
        return "cov is neither 3 standard deviations [m, m, rad] nor a matrix of 3 by 3"
    try:
        made = PosePrior(
            float(numbers["x"]),
            float(numbers["y"]),
            float(numbers["theta"]),
            cov,
            float(numbers["weight"]),
            name or "",
        )
    except OverflowError:
        return "a number is too large"
    return made.fault or made


def _nine(given: Any) -> tuple[float, ...] | None:
    """A matrix row by row, of one or of standard deviations; None where it is neither."""
    if not isinstance(given, list | tuple) or len(given) != 3:
        return None
    is_matrix = all(isinstance(row, list | tuple) and len(row) == 3 for row in given)
    flat = [value for row in given for value in row] if is_matrix else list(given)
    if any(type(value) not in (int, float) for value in flat):
        return None
    try:
        values = [float(value) for value in flat]
    except OverflowError:
        return None
    if is_matrix:
        return tuple(values)
    if any(not 0.0 < value <= max(MOST_SD) for value in values):
        values = [math.nan] * 3
    sx, sy, turn = (value * value for value in values)
    return sx, 0.0, 0.0, 0.0, sy, 0.0, 0.0, 0.0, turn
