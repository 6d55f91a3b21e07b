"""What a taxel may read of presses beside it: cross-talk of its module, and skin that sags."""

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout

CROSS_TALK = 0.05  # of what the other taxels of its module read together (docs/physics.md)
SAG = 0.1  # of the most that a taxel beside it reads
BESIDE = 1.5  # nearest distances


class Leak:
    """Of one skin's M taxels."""

    def __init__(self, layout: Layout) -> None:
        module = layout.uid >> 4
        self._member = (module[:, None] == np.unique(module)).astype(np.float64)  # (M, modules)
        place = layout.position_m
        apart = np.linalg.norm(place[:, None] - place, axis=-1)
        np.fill_diagonal(apart, np.inf)
        self._coupled = CROSS_TALK * (module[:, None] == module)
        np.fill_diagonal(self._coupled, 0.0)
        beside = apart <= BESIDE * np.median(apart.min(axis=1))
        most = int(beside.sum(axis=1).max(initial=1))
        order = np.argsort(apart, axis=1)[:, :most]
        self._beside = order.T.copy()  # (neighbours, M)
        self._share = SAG * np.take_along_axis(beside, order, axis=1).T.copy()

    def of(self, z: Floats) -> Floats:
        """Activations z (M,) or (n, M) → as many, about the most that each has from elsewhere."""
        if z.ndim > 1:
            return self._of_many(z)
        sag = (self._share * z.take(self._beside)).max(axis=0)
        return np.asarray(z @ self._coupled.T + sag)

    def _of_many(self, z: Floats) -> Floats:
        """The same of z (n, M), within rounding: training asks it of every batch, and a tenth of
        the time is enough where taxels are rows."""
        of_taxel = np.ascontiguousarray(z.T)
        member = self._member.astype(z.dtype)
        others = member @ (member.T @ of_taxel) - of_taxel  # of its module
        sag = np.zeros_like(of_taxel)
        for share, beside in zip(self._share.astype(z.dtype), self._beside, strict=True):
            np.maximum(sag, share[:, None] * of_taxel.take(beside, axis=0), out=sag)
        return np.asarray((CROSS_TALK * np.maximum(others, 0.0) + sag).T)

    def without(
        self, z: Floats, floor: Floats | float, residue: Floats | float = 0.0
    ) -> tuple[Floats, Floats, Floats]:
        """Activations z (..., M) that are 0 under a floor → those that are evidence of a press at
        the taxel itself, 0 where they may be from elsewhere; their floor; and what may be in them
        of other presses, with the `residue` of earlier ones. Each (..., M)."""
        if not z.any():  # nothing is pressed, and so nothing leaks
            return z, np.broadcast_to(floor, z.shape), np.broadcast_to(residue, z.shape)
        leak = self.of(z)
        raised = np.maximum(floor, leak)
        return np.where(z < raised, 0.0, z), raised, np.hypot(residue, leak)
