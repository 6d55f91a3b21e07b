"""The leak of a press into taxels beside it: cross-talk of its module, and skin that sags.

Sag around the link is a part of the observation model (`response.sagging`). An object may also end
along the link, which the model does not follow: so what taxels above and below may add is held back
here.
"""

import numpy as np

from taxeld.arrays import Floats, Index
from taxeld.layout.layout import Layout

CROSS_TALK = 0.05  # share of the sum over the other taxels of the module (docs/physics.md)
REACH_M = 0.006  # m: the cover sags by 1/e so far beside one press in ten (docs/physics.md)
LEAST = 0.01  # smaller shares of a press leave nothing


class Leak:
    """The leak between one skin's M taxels."""

    def __init__(self, layout: Layout) -> None:
        module = layout.uid >> 4
        self._member = (module[:, None] == np.unique(module)).astype(np.float64)  # (M, modules)
        place = layout.position_m
        apart = np.linalg.norm(place[:, None] - place, axis=-1)
        np.fill_diagonal(apart, np.inf)
        sag = np.exp(-apart / REACH_M)
        height = place[:, None, 2] - place[:, 2]
        self._along = _strongest(sag * (height / apart) ** 2)
        self._all = _strongest(sag)

    def of(self, z: Floats) -> Floats:
        """Activations (M,) or (n, M) → about the most that each taxel may read from elsewhere and
        the observation model does not follow, in the same shape."""
        return self._leaked(z, *self._along)

    def drawn(self, z: Floats) -> Floats:
        """Activations (M,) or (n, M) → about the most that each taxel may read from elsewhere,
        followed by the model or not, in the same shape: samplers are trained with it."""
        return self._leaked(z, *self._all)

    def _leaked(self, z: Floats, shares: Floats, besides: Index) -> Floats:
        of_taxel = np.ascontiguousarray(z.T)  # taxels first: training reads thousands of scans
        member = self._member.astype(z.dtype)
        others = member @ (member.T @ of_taxel) - of_taxel  # other taxels of the module
        sag = np.zeros_like(of_taxel)
        for share, beside in zip(shares.astype(z.dtype), besides, strict=True):
            np.maximum(sag.T, share * of_taxel.take(beside, axis=0).T, out=sag.T)
        return np.asarray((CROSS_TALK * np.maximum(others, 0.0) + sag).T)

    def without(
        self, z: Floats, floor: Floats | float, residue: Floats | float = 0.0
    ) -> tuple[Floats, Floats, Floats]:
        """Separate presses from leaks. Activations z (..., M) are 0 under `floor`; `residue` comes
        from earlier presses. → activations that show a press at the taxel itself, 0 where they may
        come from elsewhere; their floors; and the parts that other presses may have added, with the
        residue. Each is (..., M)."""
        leak = self.of(z)
        raised = np.maximum(floor, leak)
        return np.where(z < raised, 0.0, z), raised, np.hypot(residue, leak)


def _strongest(share: Floats) -> tuple[Floats, Index]:
    """Shares (M, M) of each column's press that each row reads → the greatest of each row, and
    their columns: (neighbours, M) each."""
    share = np.where(share < LEAST, 0.0, share)
    most = int(np.count_nonzero(share, axis=1).max())
    order = np.argsort(-share, axis=1)[:, :most]
    return np.take_along_axis(share, order, axis=1).T.copy(), order.T.copy()
