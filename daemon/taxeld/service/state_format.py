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


ARRAYS = {  # digits, least, most, whether nan is allowed (null in the file)
    "baseline": (2, 0.0, COUNT_MAX, True),
    "noise": (2, 0.0, COUNT_MAX, False),
    "coefficient": (5, -100.0, 100.0, False),
    "leak": (5, 0.0, 1.0, False),
    "t0": (2, -COUNT_MAX, COUNT_MAX, True),
}
OF_TAXELS = ("baseline", "noise")  # the others are of modules


def dump(state: SkinState) -> bytes:
    """As JSON, in one line."""
    data: dict[str, Any] = {"version": VERSION, "t": round(state.t, 3), "digest": state.digest}
    for name, (digits, *_) in ARRAYS.items():
        values = np.round(getattr(state, name), digits).tolist()
        data[name] = [None if math.isnan(value) else value for value in values]
    return json.dumps(data, separators=(",", ":"), allow_nan=False).encode()


def parse(text: bytes, digest: str, taxels: int, modules: int) -> SkinState:
    """What `dump` wrote for this very skin.

    Raises:
        ValueError: it is damaged, or of another skin.
    """
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        data = None
    if not isinstance(data, dict) or "version" not in data:
        raise ValueError("it is damaged")
    if data["version"] != VERSION:
        raise ValueError(f"it is of version {data['version']!r:.20}, not {VERSION}")
    if data.get("digest") != digest:
        raise ValueError("it is of another skin")
    t = data.get("t")
    if not isinstance(t, int | float) or not abs(t) < TIME_MAX:
        raise ValueError("its time is damaged")
    arrays = {
        name: _array(data.get(name), name, taxels if name in OF_TAXELS else modules)
        for name in ARRAYS
    }
    return SkinState(t=float(t), digest=digest, **arrays)


def _array(values: Any, name: str, size: int) -> Floats:
    _, low, high, gaps = ARRAYS[name]
    is_list = isinstance(values, list) and len(values) == size
    if not is_list or not all(
        low <= value <= high if isinstance(value, int | float) else gaps and value is None
        for value in values
    ):
        raise ValueError(f"its {name} is damaged")
    return np.array(values, dtype=np.float64)
