"""Rows of experiments, as pictures read them: a row is one filter on one object and skin."""

import math
import re
from collections.abc import Mapping
from typing import Any

GRID = "grid"  # `proposal` of the grid filter's rows
ALL = "all"  # object of a row over all objects

Row = Mapping[str, Any]


def number(value: Any) -> float:
    return math.nan if value is None else float(value)


def object_name(name: str) -> str:
    """003_cracker_box → cracker box."""
    return re.sub(r"^\d+(-\w)?_", "", name).replace("_", " ")


def condition(row: Row) -> str:
    """The factor and level in which a row's trials differ from a filter's assumptions."""
    factor, level = row.get("factor", "as assumed"), row.get("level")
    if factor == "as assumed":
        return str(factor)
    return f"{factor}: {object_name(level) if isinstance(level, str) else format(level, 'g')}"
