"""A skin's state as JSON, less than 50 kB."""

import json
import math
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld.skin.state import SkinState

VERSION = 1
COUNT_MAX = 0xFFFF
TIME_MAX = 1e15


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
    if not isinstance(data, dict) or "version" not in data:
        raise ValueError("it is damaged")
    if data["version"] != VERSION:
        raise ValueError(f"it is of version {data['version']!r:.20}, not {VERSION}")
    if data.get("digest") != digest:
        raise ValueError("it is of another skin")
    t = data.get("t")
    if not isinstance(t, int | float) or not abs(t) < TIME_MAX:
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
