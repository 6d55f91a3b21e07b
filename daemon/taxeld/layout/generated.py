"""Layouts made from a line of numbers: an even grid, or CySkin triangles, around a cylinder.

Both have ten taxels a module on one hub, with UIDs `SUI << 4 | name`: SUI 1, 2, … and name 1..10.
"""

from collections.abc import Callable
from typing import get_type_hints

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld_protocol.modules import MAX_MODULES

TAXELS_PER_MODULE = 10  # wiring of a generated cylinder; a real CySkin triangle has ten as well
MAX_TAXELS = MAX_MODULES * TAXELS_PER_MODULE  # modules that an IHB can address × taxels
LENGTH_MAX_M = 10.0
SUI_MAX = 1_000_000

# Measured places of T1..T10 in a CySkin triangle: from its middle, base above, apex below.
TRIANGLE_M = 1e-3 * np.array(
    [
        (12.0, 5.657), (4.0, 5.657), (-4.0, 5.657), (-12.0, 5.657), (-8.0, 0.0),
        (-4.0, -5.657), (0.0, -11.314), (4.0, -5.657), (8.0, 0.0), (0.0, 0.0),
    ]
)  # fmt: skip
MODULE_M = 0.020  # width of a module around the link: bases of 40 mm, every other one above
HEIGHT_M = 0.028285  # height of a triangle and of a row, which is five rows of taxels

EXAMPLES = {
    "cylinder": "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015",
    "wrap": "wrap:modules=12,radius_m=0.04,rows=2",
}


def cylinder(rows: int, columns: int, radius_m: float, pitch_m: float, sui: int = 1) -> Layout:
    """An even grid: row by row from below, column 0 at angle 0, counter-clockwise; `sui`: of the
    first module.

    Raises:
        ValueError: no taxels, more than a hub carries, or a length that is not positive.
    """
    if not (rows > 0 and columns > 0 and rows * columns <= MAX_TAXELS):
        raise ValueError(f"rows × columns must be 1..{MAX_TAXELS}, not {rows} × {columns}")
    _check_lengths(radius_m=radius_m, pitch_m=pitch_m)
    r, c = (a.ravel() for a in np.mgrid[0:rows, 0:columns])
    name = f"cylinder:rows={rows},columns={columns},radius_m={radius_m:g},pitch_m={pitch_m:g}"
    height = (r - (rows - 1) / 2.0) * pitch_m
    if not 0 < sui <= SUI_MAX:
        raise ValueError(f"sui must be 1..{SUI_MAX}, not {sui}")
    name += f",sui={sui}" if sui > 1 else ""
    return _around(name, 2.0 * np.pi * c / columns, height, radius_m, sui)


def wrap(modules: int, radius_m: float, rows: int = 1) -> Layout:
    """CySkin triangles, `modules` of them in each row, apex down and apex up in turn.

    Module 0 of the lowest row stands at angle 0 with its apex down; modules go counter-clockwise
    and rows upwards, bases on bases. Modules are spread evenly around the circle: where their 20 mm
    each do not fill it, all gaps are equal. Taxels are T1..T10 of module 0, of module 1, ….

    Raises:
        ValueError: the modules do not alternate, do not fit, or are too many for a hub.
    """
    if not (modules > 0 and modules % 2 == 0 and rows > 0):
        raise ValueError(f"modules must be even, as they alternate, and rows 1 or more: {modules}")
    if modules * rows > MAX_MODULES:
        raise ValueError(f"modules × rows must be at most {MAX_MODULES}, not {modules} × {rows}")
    _check_lengths(radius_m=radius_m)
    least_m = modules * MODULE_M / (2.0 * np.pi)
    if radius_m < least_m - 1e-9:
        raise ValueError(
            f"{modules} modules take {modules * MODULE_M * 1e3:g} mm around; "
            f"radius_m must be at least {least_m:.4f}, or modules fewer"
        )
    r, c = (a.ravel()[:, None] for a in np.mgrid[0:rows, 0:modules])
    up = np.where((r + c) % 2 == 0, 1.0, -1.0)  # +1: as TRIANGLE_M; −1: half a turn
    middle = up * HEIGHT_M / 6.0  # a triangle's middle is a third of its height off its base
    height = (r - (rows - 1) / 2.0) * HEIGHT_M + middle + up * TRIANGLE_M[:, 1]
    angle = 2.0 * np.pi * c / modules + up * TRIANGLE_M[:, 0] / radius_m
    name = f"wrap:modules={modules},radius_m={radius_m:g},rows={rows}"
    return _around(name, angle.ravel(), height.ravel(), radius_m)


KINDS: dict[str, Callable[..., Layout]] = {"cylinder": cylinder, "wrap": wrap}


def parse(spec: str) -> Layout | None:
    """The layout that `kind:key=value,…` describes; None if `kind` is not one of these.

    Raises:
        ValueError: a key or value that the kind does not take, with an example that works.
    """
    kind, colon, rest = spec.partition(":")
    make = KINDS.get(kind) if colon else None
    if make is None:
        return None
    keys = get_type_hints(make)
    del keys["return"]
    values: dict[str, int | float] = {}
    for item in rest.split(","):
        key, _, text = item.partition("=")
        if key not in keys:
            raise ValueError(f"unknown {kind} key '{key}'; use '{EXAMPLES[kind]}'")
        try:
            values[key] = keys[key](text)
        except ValueError:
            raise ValueError(f"'{item}' is not {key}=<{keys[key].__name__}>") from None
    missing = keys.keys() - values - ({"rows"} if make is wrap else {"sui"})
    if missing:
        raise ValueError(f"{kind} lacks {', '.join(sorted(missing))}; use '{EXAMPLES[kind]}'")
    return make(**values)


def _around(name: str, angle: Floats, height_m: Floats, radius_m: float, sui: int = 1) -> Layout:
    """Taxels on a cylinder, at angles (M,) [rad] and heights (M,)."""
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    position = radius_m * normal
    position[:, 2] = height_m
    i = np.arange(len(angle))
    uid = (i // TAXELS_PER_MODULE + sui) << 4 | (i % TAXELS_PER_MODULE + 1)
    return Layout(name, uid, position, normal, radius_m)


def _check_lengths(**lengths_m: float) -> None:
    if not all(0.0 < value < LENGTH_MAX_M for value in lengths_m.values()):
        raise ValueError(f"{' and '.join(lengths_m)} must be positive lengths in metres")
