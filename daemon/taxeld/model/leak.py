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
# taxels of which a taxel reads most: hardly more are within reach where they stand 4 mm apart
NEIGHBOURS = 128
MODULES = 512  # whose taxels are summed at a time


class Leak:
    """The leak between one skin's M taxels."""

    def __init__(self, layout: Layout) -> None:
        suis, self._module = np.unique(layout.uid >> 4, return_inverse=True)  # of each taxel
        self._modules = np.split(np.arange(len(suis)), range(MODULES, len(suis), MODULES))
        blocks, few = [], min(NEIGHBOURS, len(layout))
        for rows, apart in layout.apart_m():
            apart[np.arange(len(apart)), rows] = np.inf  # a press is no leak into itself
            near = np.argpartition(apart, few - 1)[:, :few].copy()
            blocks.append((near, np.take_along_axis(apart, near, axis=1)))
        near, apart = (np.concatenate(part) for part in zip(*blocks, strict=True))  # (M, few) each
        sag, height = np.exp(-apart / REACH_M), layout.position_m[:, 2]
        rise = height[:, None] - height[near]
        steep = np.divide(rise, apart, out=np.zeros_like(apart), where=apart > 0.0)
        self._along = _strongest(sag * steep**2, near)
        self._all = _strongest(sag, near)

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
        others = -of_taxel  # of the module
        for modules in self._modules:
            member = (self._module[:, None] == modules).astype(z.dtype)
            others += member @ (member.T @ of_taxel)
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


def _strongest(share: Floats, column: Index) -> tuple[Floats, Index]:
    """Shares (M, n) of the presses of taxels `column` (M, n) that each row reads → the greatest of
    each row, and their columns: (neighbours, M) each."""
    share = np.where(share < LEAST, 0.0, share)
    most = int(np.count_nonzero(share, axis=1).max())
    order = np.argsort(-share, axis=1)[:, :most]
    greatest = np.take_along_axis(share, order, axis=1)
    return greatest.T.copy(), np.take_along_axis(column, order, axis=1).T.copy()
