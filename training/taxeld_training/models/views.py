"""Views of a touch: turned to its strongest taxel, so that a model has less to learn.

A view is the head of every exported graph: z, live (B, M) of the skin → features (B, F) and the
angle (B,) by which the touch was turned. Models learn poses turned by it, and turn samples back.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor, nn

from taxeld.layout.layout import Layout

TURNED_ORDER = 6  # least order of symmetry at which turning is better than a window
WINDOW_RAD = 0.7  # half width of the window; a flat face pressed 5 mm deep covers half of it


class Plain(nn.Module):
    """The taxels as they are: the paper's."""

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self.width = 2 * len(layout)

    def forward(self, z: Tensor, live: Tensor) -> tuple[Tensor, Tensor]:
        """z, live (B, M) → features (B, F) and angle (B,)."""
        return torch.cat([z * live, live], dim=-1), torch.zeros_like(z[:, 0])


class Turned(nn.Module):
    """The taxels turned by the layout's rotation symmetry, the strongest one's sector to angle 0.

    Exact: a ring of equal columns has the same readings when turned by a column.
    """

    turns: Tensor  # (n, M) taxels after each turn
    sector: Tensor  # (M,) turn that brings each taxel to angle 0

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self.width = 3 * len(layout)
        self.register_buffer("turns", torch.from_numpy(layout.turns.astype(np.int64)))
        self.register_buffer("sector", torch.from_numpy(layout.sector))

    def forward(self, z: Tensor, live: Tensor) -> tuple[Tensor, Tensor]:
        """z, live (B, M) → features (B, F) and angle (B,)."""
        z = z * live
        turn = self.sector[z.argmax(dim=1)]
        taxels = self.turns[turn]
        return _seen(z.gather(1, taxels), live.gather(1, taxels)), turn.float() * (
            2.0 * torch.pi / len(self.turns)
        )


class Centred(nn.Module):
    """A window that follows the touch, for a layout without symmetry.

    Taxels are spread bilinearly onto a regular grid of angle × height about the strongest one's
    direction, so that their places between the cells are kept. The grid of live taxels is kept
    too, since silence of a bare side is no evidence.
    """

    angle: Tensor  # (M,) [rad] direction of each taxel
    row: Tensor  # (2, M) the grid's rows below and above each
    rise: Tensor  # (2, M) each taxel's share in these rows
    whole: Tensor  # (M, F / 3) the grid of live taxels about each, where none is dead

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        xyz = layout.position_m
        gap = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1)
        pitch = float(np.median(np.sort(gap, axis=1)[:, min(1, len(xyz) - 1)])) or 0.01
        self.cells_per_rad = layout.radius_m / pitch
        self.reach = int(np.ceil(WINDOW_RAD * self.cells_per_rad))
        height = (xyz[:, 2] - xyz[:, 2].min()) / pitch
        below = np.floor(height).astype(np.int64)
        self.rows = int(below.max()) + 2
        self.width = 3 * self.rows * (2 * self.reach + 1)
        direction = np.arctan2(xyz[:, 1], xyz[:, 0])
        self.register_buffer("angle", torch.from_numpy(direction).float())
        self.register_buffer("row", torch.from_numpy(np.stack([below, below + 1])))
        share = height - below
        self.register_buffer("rise", torch.from_numpy(np.stack([1.0 - share, share])).float())
        every = torch.ones(len(xyz), len(xyz))
        whole = self._of_all(every, every, self.angle)[:, -self.width // 3 :]
        self.register_buffer("whole", whole.clone(), persistent=False)

    def forward(self, z: Tensor, live: Tensor) -> tuple[Tensor, Tensor]:
        """z, live (B, M) → features (B, F) and angle (B,)."""
        z = z * live
        strongest = z.argmax(dim=1)
        angle = self.angle[strongest]
        if len(z) > 1:
            return self._of_many(z, live, strongest), angle
        return self._of_all(z, live, angle), angle

    def _of_all(self, z: Tensor, live: Tensor, angle: Tensor) -> Tensor:
        """Features (B, F) of touches seen from `angle` (B,), by every taxel of the skin."""
        grids = [torch.zeros(len(z), self.width // 3, device=z.device) for _ in range(2)]
        for cell, part in self._cells(self.angle - angle[:, None], slice(None)):
            grids[0] = grids[0].scatter_add(1, cell, z * part)
            grids[1] = grids[1].scatter_add(1, cell, live * part)
        return _seen(*grids)

    def _of_many(self, z: Tensor, live: Tensor, strongest: Tensor) -> Tensor:
        """Features (B, F) as `_of_all` has them, within rounding, by the few taxels that are
        pressed or dead, in a tenth of the time: training asks for them in every batch."""
        alive = self.whole[strongest] - self._spread(1.0 - live, strongest)
        return _seen(self._spread(z, strongest), alive.clamp(min=0.0))

    def _spread(self, value: Tensor, strongest: Tensor) -> Tensor:
        """Values (B, M), 0 but for a few, on grids about the strongest taxels (B,)."""
        touch, taxel = value.nonzero(as_tuple=True)
        given = value[touch, taxel]
        grid = value.new_zeros(len(value) * (self.width // 3))
        for cell, part in self._cells(self.angle[taxel] - self.angle[strongest[touch]], taxel):
            grid.index_add_(0, touch * (self.width // 3) + cell, given * part)
        return grid.view(len(value), -1)

    def _cells(self, off: Tensor, taxels: Tensor | slice) -> Iterator[tuple[Tensor, Tensor]]:
        """The four cells that `taxels` lie between, `off` [rad] beside the window's middle, each
        with the share in it; 0 outside the window."""
        off = off - 2.0 * torch.pi * torch.round(off / (2.0 * torch.pi))
        at = off * self.cells_per_rad + self.reach
        left = torch.floor(at)
        columns = 2 * self.reach + 1
        for column, share in ((left, 1.0 - (at - left)), (left + 1.0, at - left)):
            share = torch.where((column >= 0) & (column < columns), share, 0.0)  # noqa: PLW2901
            first = column.clamp(0, columns - 1).long() * self.rows
            for row, rise in zip(self.row, self.rise, strict=True):
                yield first + row[taxels], share * rise[taxels]


def _seen(z: Tensor, live: Tensor) -> Tensor:
    """Activations, their roots, which tell slight touches apart, and live taxels, in a row."""
    return torch.cat([z, torch.sqrt(z), live], dim=-1)


def best(layout: Layout) -> Turned | Centred:
    """The view for a layout: `Turned` where its symmetry is high enough."""
    return Turned(layout) if len(layout.turns) >= TURNED_ORDER else Centred(layout)
