"""The leak of a press into taxels beside it: cross-talk of its module, and skin that sags."""

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout

CROSS_TALK = 0.05  # share of the sum over the other taxels of the module (docs/physics.md)
SAG = 0.1  # share of the strongest taxel beside it
BESIDE = 1.5  # median nearest distances: taxels this near are beside each other


class Leak:
    """The leak between one skin's M taxels."""

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
        """Activations (M,) or (n, M) → about the most that each taxel may read from elsewhere, in
        the same shape."""
        if z.ndim > 1:
            return self._of_many(z)
        sag = (self._share * z.take(self._beside)).max(axis=0)
        return np.asarray(z @ self._coupled.T + sag)

    def _of_many(self, z: Floats) -> Floats:
        """`of` for activations (n, M), within rounding, in a tenth of the time: training calls it
        for every batch."""
        of_taxel = np.ascontiguousarray(z.T)
        member = self._member.astype(z.dtype)
        others = member @ (member.T @ of_taxel) - of_taxel  # other taxels of the module
        sag = np.zeros_like(of_taxel)
        for share, beside in zip(self._share.astype(z.dtype), self._beside, strict=True):
            np.maximum(sag, share[:, None] * of_taxel.take(beside, axis=0), out=sag)
        return np.asarray((CROSS_TALK * np.maximum(others, 0.0) + sag).T)

    def without(
        self, z: Floats, floor: Floats | float, residue: Floats | float = 0.0
    ) -> tuple[Floats, Floats, Floats]:
        """Separate presses from leaks. Activations z (..., M) are 0 under `floor`; `residue` comes
        from earlier presses. → activations that show a press at the taxel itself, 0 where they may
        come from elsewhere; their floors; and the parts that other presses may have added, with the
        residue. Each is (..., M)."""
        if not z.any():  # nothing is pressed, and so nothing leaks
            return z, np.broadcast_to(floor, z.shape), np.broadcast_to(residue, z.shape)
        leak = self.of(z)
        raised = np.maximum(floor, leak)
        return np.where(z < raised, 0.0, z), raised, np.hypot(residue, leak)
