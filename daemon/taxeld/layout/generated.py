"""Layouts made from a line of numbers: an even grid, or CySkin triangles, around a cylinder.

Both have ten taxels a module on one hub, with UIDs `SUI << 4 | name`: SUI 1, 2, … and name 1..10.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Floats
from taxeld.config import gate
from taxeld.config.gate import between, key
from taxeld.layout.layout import Layout
from taxeld_protocol.modules import MAX_MODULES

TAXELS_PER_MODULE = 10  # wiring of a generated cylinder; a real CySkin triangle has ten as well
MAX_TAXELS = MAX_MODULES * TAXELS_PER_MODULE  # modules that an IHB can address × taxels
LENGTH_M = between(1e-6, 10)

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


@dataclass(frozen=True, slots=True)
class Cylinder:
    """An even grid: row by row from below, column 0 at angle 0, counter-clockwise."""

    rows: int = key(check=between(1, MAX_TAXELS))
    columns: int = key(check=between(1, MAX_TAXELS))
    radius_m: float = key(check=LENGTH_M)
    pitch_m: float = key(check=LENGTH_M)
    sui: int = key(1, between(1, 1_000_000))  # of the first module

    @property
    def fault(self) -> str:
        return f"rows × columns must be 1..{MAX_TAXELS}" * (self.rows * self.columns > MAX_TAXELS)

    def layout(self, name: str) -> Layout:
        r, c = (a.ravel() for a in np.mgrid[0 : self.rows, 0 : self.columns])
        height = (r - (self.rows - 1) / 2.0) * self.pitch_m
        return _around(name, 2.0 * np.pi * c / self.columns, height, self.radius_m, self.sui)


@dataclass(frozen=True, slots=True)
class Wrap:
    """CySkin triangles, `modules` of them in each row, apex down and apex up in turn.

    Module 0 of the lowest row stands at angle 0 with its apex down; modules go counter-clockwise
    and rows upwards, bases on bases. Modules are spread evenly around the circle: where their 20 mm
    each do not fill it, all gaps are equal. Taxels are T1..T10 of module 0, of module 1, ….
    """

    modules: int = key(check=between(2, MAX_MODULES))
    radius_m: float = key(check=LENGTH_M)
    rows: int = key(1, between(1, MAX_MODULES))

    @property
    def fault(self) -> str:
        least_m = self.modules * MODULE_M / (2.0 * np.pi)
        if self.modules % 2:
            return f"modules: must be even, as they alternate, not {self.modules}"
        if self.modules * self.rows > MAX_MODULES:
            return f"modules × rows: must be at most {MAX_MODULES}"
        if self.radius_m < least_m - 1e-9:
            return f"radius_m: must be at least {least_m:.4f} for {self.modules} modules"
        return ""

    def layout(self, name: str) -> Layout:
        r, c = (a.ravel()[:, None] for a in np.mgrid[0 : self.rows, 0 : self.modules])
        up = np.where((r + c) % 2 == 0, 1.0, -1.0)  # +1: as TRIANGLE_M; −1: half a turn
        middle = up * HEIGHT_M / 6.0  # a triangle's middle is a third of its height off its base
        height = (r - (self.rows - 1) / 2.0) * HEIGHT_M + middle + up * TRIANGLE_M[:, 1]
        angle = 2.0 * np.pi * c / self.modules + up * TRIANGLE_M[:, 0] / self.radius_m
        return _around(name, angle.ravel(), height.ravel(), self.radius_m)


KINDS: dict[str, type[Cylinder | Wrap]] = {"cylinder": Cylinder, "wrap": Wrap}


def parse(spec: str) -> Layout | None:
    """The layout that `kind:key=value,…` describes; None if `kind` is not one of these.

    Raises:
        ValueError: a key or value that the kind does not take, with an example that works.
    """
    kind, colon, rest = spec.partition(":")
    if not colon or kind not in KINDS:
        return None
    values = {name: _number(text) for name, _, text in (i.partition("=") for i in rest.split(","))}
    faults: list[str] = []
    made = gate.take(KINDS[kind], values, faults)
    if made is None or made.fault:
        fault = made.fault if made else faults[0]
        raise ValueError(f"{kind}: {fault}; use '{EXAMPLES[kind]}'")
    return made.layout(spec)


def _number(text: str) -> int | float | str:
    """A number, or the text where it is none."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _around(name: str, angle: Floats, height_m: Floats, radius_m: float, sui: int = 1) -> Layout:
    """Taxels on a cylinder, at angles (M,) [rad] and heights (M,); `sui`: of the first module."""
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    position = radius_m * normal
    position[:, 2] = height_m
    i = np.arange(len(angle))
    uid = (i // TAXELS_PER_MODULE + sui) << 4 | (i % TAXELS_PER_MODULE + 1)
    return Layout(name, uid, position, normal, radius_m)
