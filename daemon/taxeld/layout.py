"""A skin's layout: where its taxels are, and which turns leave it unchanged."""

import hashlib
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taxeld import cylinder_fit, generated, layout_files
from taxeld.errors import SetupError
from taxeld.layout_files import Source

TURN_TOLERANCE_M = 1e-4
BLOCK = 64  # taxels matched at a time


@dataclass(frozen=True)
class Layout:
    """M taxels on a link that is, for contact, a cylinder about the sensor frame's z axis."""

    name: str
    uid: NDArray[np.int64]  # (M,) SUI << 4 | name, as on the wire
    position_m: NDArray[np.float64]  # (M, 3) in the sensor frame
    normal: NDArray[np.float64]  # (M, 3) unit, outwards
    radius_m: float  # inf: the taxels lie on no cylinder
    frame: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    """(4, 4) rigid transform from the layout file's frame [m] to the sensor frame, which
    `cylinder_fit.fit` defines; a robot that knows the file's frame finds the sensor by it."""
    source: Source = field(default_factory=Source)
    turned: int = 0  # normals that the file has pointing inwards

    def __len__(self) -> int:
        return len(self.uid)

    @cached_property
    def digest(self) -> str:
        """16 hex digits that name the geometry (to 10 µm), for bundles to refer to."""
        geometry = np.round(np.hstack([self.position_m, self.normal]) * 1e5).astype("<i8")
        return hashlib.sha256(geometry.tobytes()).hexdigest()[:16]

    @cached_property
    def rms_m(self) -> float:
        """How far the taxels lie from the cylinder; nan where there is none."""
        if math.isinf(self.radius_m):
            return math.nan
        radius = np.hypot(self.position_m[:, 0], self.position_m[:, 1])
        return math.sqrt(np.mean((radius - self.radius_m) ** 2))

    @cached_property
    def turns(self) -> NDArray[np.int64]:
        """(n, M) permutations: `z[turns[k]]` is what z becomes when the touch turns by −2πk/n.

        n is the order of the layout's rotation symmetry about z, 1 where it has none.
        """
        turns = [np.arange(len(self))]
        for order in range(len(self), 1, -1):
            match = self._match(2.0 * np.pi / order) if len(self) % order == 0 else None
            if match is not None:
                for _ in range(order - 1):
                    turns.append(match[turns[-1]])
                break
        return np.array(turns)

    @cached_property
    def sector(self) -> NDArray[np.int64]:
        """(M,) the turn that brings each taxel to angle 0."""
        order = len(self.turns)
        angle = np.arctan2(self.position_m[:, 1], self.position_m[:, 0])
        return np.round(angle * order / (2.0 * np.pi)).astype(np.int64) % order

    def _match(self, angle: float) -> NDArray[np.int64] | None:
        """For each taxel, the one that lies where it comes to when turned; None if one is not."""
        c, s = np.cos(angle), np.sin(angle)
        turned = self.position_m @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        match = np.empty(len(self), dtype=np.int64)
        for start in range(0, len(self), BLOCK):
            block = slice(start, start + BLOCK)
            gap = np.linalg.norm(turned[block, None] - self.position_m, axis=-1)
            if gap.min(axis=1).max() >= TURN_TOLERANCE_M:
                return None
            match[block] = gap.argmin(axis=1)
        return match if len(np.unique(match)) == len(self) else None


def load(spec: str) -> Layout:
    """The layout that `skin.layout` names, for a run.

    Raises:
        SetupError: it cannot be read, or its taxels lie on no cylinder.
    """
    layout = read(spec)
    if math.isinf(layout.radius_m):
        raise SetupError(
            f"skin.layout: {layout.name}: its {len(layout)} taxels lie on no cylinder (flat, or a "
            "file without true normals); a run needs the skin of a round link"
        )
    return layout


def read(spec: str) -> Layout:
    """The layout that `skin.layout` names, on a cylinder or not.

    Raises:
        SetupError: the text is no layout, or the file cannot be used.
    """
    try:
        made = generated.parse(spec)
        if made is not None:
            return Layout(made.name, made.uid, made.position_m, made.normal, made.radius_m)
        if Path(spec).suffix.lower() not in layout_files.READERS:
            raise ValueError(
                f"'{spec}' is no known layout; use '{generated.EXAMPLES['cylinder']}', "
                f"'{generated.EXAMPLES['wrap']}', a robotskinlib .json or an iCub positions .txt"
            )
        return _of_patch(Path(spec).stem, layout_files.read(Path(spec)))
    except ValueError as error:
        raise SetupError(f"skin.layout: {error}") from None


def _of_patch(name: str, patch: layout_files.Patch) -> Layout:
    """The patch in its sensor frame; `name` is the file's, as names inside files repeat."""
    fit = cylinder_fit.fit(patch.position_m, patch.normal)
    turn, shift = fit.frame[:3, :3], fit.frame[:3, 3]
    outwards = np.where(fit.inwards[:, None], -patch.normal, patch.normal)
    return Layout(
        name=name,
        uid=patch.uid,
        position_m=patch.position_m @ turn.T + shift,
        normal=outwards @ turn.T,
        radius_m=fit.radius_m,
        frame=fit.frame,
        source=patch.source,
        turned=int(fit.inwards.sum()),
    )
