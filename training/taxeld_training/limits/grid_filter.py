"""The limit of the filters: a Bayes filter on a sparse grid, no chance.

It speaks the likelihood of the estimator: floors and residues, an offset of each scan's own, a
contact that counts once however many scans are of it, and a slack that the evidence chooses. After
each contact it looks at every pose that a strong touch allows (`grid_cells`), weighs them by all
scans so far, drops those that no longer matter, and halves those that may weigh something and whose
extent changes readings by more than their noise. The cells are the leaves of a tree of boxes.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimate import MODE_CANDIDATES, MODE_RADIUS_M, MODES_MAX
from taxeld.estimator.memory import Slack
from taxeld.estimator.mixture import SCALES
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld_training.limits.grid_cells import Cells, tile
from taxeld_training.limits.grid_likelihood import CellLikelihood, Evidence

DROP_NATS = 14.0  # a cell whose best pose is this far below the belief no longer matters
COARSE = 0.5  # information in a cell from which it is halved: an extent of 2.4 sd
SHARE = 3e-4  # share of the belief; a cell that cannot weigh more may stay coarse
CELLS = 60_000  # most cells; beyond them none is halved
SLACK_FROM = 3  # contacts: fewer agree with any slack
PICKED = 32 * MODE_CANDIDATES  # poses among which modes are sought
RECENT = 3  # contacts; the strongest of their touches is tiled, as a weak one may be noise
MARGIN_SD = 3.0  # standard deviations of the tiled touch's offset


class GridScan(NamedTuple):
    """A scan that the filter has learned from."""

    observation: Observation
    touched: bool
    contact: int  # number of its contact; a silent scan has the last contact's


class GridFilter:
    """The belief over where the object now is, given all scans so far.

    The prior is uniform over the poses that a touch may have; the noise's share of outliers must
    not be zero. The same scans give the same belief.
    """

    def __init__(self, model: ObservationModel, noise: Noise, slack: Slack) -> None:
        """`slack`: by how much scans may be off, as the estimator has it."""
        self.metric = PoseMetric(model.scene)
        self.slack = slack
        self._model = model
        self._likelihood = CellLikelihood(model, noise)
        self._scans: list[GridScan] = []
        self._scale = 0  # index into SCALES of the likeliest; the least scale has the fewest cells
        self._weighed = 0  # scans that the cells have taken
        self._first = se2.IDENTITY  # the sensor's pose at the touch that is tiled
        self._cells = Cells.unweighed(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self._settled())

    @property
    def pose(self) -> Poses:
        """(n, 3) midpoints of the cells in the world; none before the first touch."""
        cells = self._settled()
        return se2.compose(self._first, contacts.pose_of_axis(*cells.mid.T))

    @property
    def weight(self) -> Floats:
        """(n,) of the cells; sums to 1."""
        cells = self._settled()
        return cells.weight if len(cells) else np.empty(0)

    def update(self, scan: Observation, contact: int, *, touched: bool) -> None:
        """Learn from a scan of the contact with a number, or, if the object does not touch the
        skin, after it. The work is done when the belief is asked for."""
        self._scans.append(GridScan(scan, touched, contact))

    def estimate(self) -> Poses:
        """The mean (3,) of the heaviest mode, as the daemon's is; there is a belief."""
        # Modes are sought around the heaviest of given poses. Those of the heaviest cells would all
        # be in one peak, so poses of equal weight are picked evenly through the belief, in an order
        # that spreads the candidates, the first of them, as evenly.
        pose, weight = self.pose, self.weight
        cumulative = np.cumsum(weight)
        cumulative[-1] = 1.0  # rounding must not leave the last without a cell
        at = (np.arange(PICKED).reshape(MODE_CANDIDATES, -1).T.ravel() + 0.5) / PICKED
        picked = pose[np.searchsorted(cumulative, at)]
        equal = np.full(PICKED, 1.0 / PICKED)
        modes = self.metric.modes(
            picked, equal, MODE_RADIUS_M * self.metric.scale, MODES_MAX, MODE_CANDIDATES
        )
        return modes[0].pose

    def _settled(self) -> Cells:
        """The cells, weighed by all scans."""
        touches = [scan for scan in self._scans if scan.touched]
        if not touches or self._weighed == len(self._scans):
            return self._cells
        self._weighed = len(self._scans)
        newest = touches[-1].contact
        recent = [scan for scan in touches if scan.contact > newest - RECENT]
        tiled = max(recent, key=lambda scan: float(scan.observation.z.sum()))
        self._first = tiled.observation.sensor
        self._cells = self._chosen(tiled, newest, len({scan.contact for scan in touches}))
        return self._cells

    def _chosen(self, tiled: GridScan, newest: int, touched: int) -> Cells:
        """The belief of the likeliest slack, uphill from the last one, once there are enough
        contacts. Evidence has one peak over its scale."""
        if touched < SLACK_FROM or not (self.slack.robot_m or self.slack.nudge_m):
            return self._belief(self.slack, tiled, newest)
        known: dict[int, Cells] = {}

        def evidence(at: int) -> float:
            if at not in known:
                slack = replace(self.slack, scale=float(SCALES[at]))
                known[at] = self._belief(slack, tiled, newest)
            return known[at].log_evidence

        while True:
            near = [at for at in (self._scale - 1, self._scale + 1) if 0 <= at < len(SCALES)]
            better = next((at for at in near if evidence(at) > evidence(self._scale)), None)
            if better is None:
                return known[self._scale]
            self._scale = better

    def _belief(self, slack: Slack, tiled: GridScan, newest: int) -> Cells:
        """Belief by all scans with a given slack, over the poses that the tiled touch allows."""
        of_contact = np.bincount([scan.contact for scan in self._scans if scan.touched])
        evidence = [
            Evidence(
                scan.observation,
                1.0 / of_contact[scan.contact] if scan.touched else 1.0,
                float(slack.variance(np.array(newest - scan.contact))),
                scan.touched,
            )
            for scan in self._scans
        ]
        own = next(e for e in evidence if e.scan is tiled.observation)
        rest = [each for each in evidence if each.touched and each is not own]
        cells = tile(self._model, MARGIN_SD * float(np.sqrt(own.variance_m2)))
        # Touches say most and come first. Silent scans meet fewer cells then.
        taken: list[Evidence] = []
        for some in ([own, *rest], [each for each in evidence if not each.touched]):
            for each in some:
                self._likelihood.add(cells, [each], self._first)
                cells = self._likely(cells)
            taken += some
            cells = self._refined(cells, taken)
        return cells

    def _likely(self, cells: Cells) -> Cells:
        """The cells in which some pose may weigh something. The bar is what a cell has on the mean,
        or a fine one at its best: a coarse one at its best promises more than it holds."""
        fine = cells.information.max(axis=1) <= COARSE
        bar = cells.log_likelihood_max.max(initial=-np.inf, where=fine)
        bar = max(bar, cells.log_likelihood.max())
        return cells[cells.log_likelihood_max >= bar - DROP_NATS]

    def _refined(self, cells: Cells, evidence: Sequence[Evidence]) -> Cells:
        """Drop the cells that do not matter and halve those that are coarse and weigh much, until
        none is left to halve."""
        while True:
            cells = self._likely(cells)
            weight = cells.log_weight_max
            coarse = (cells.information.max(axis=1) > COARSE) & (weight > np.log(SHARE))
            room = CELLS - len(cells)
            if not coarse.any() or room <= 0:
                return cells
            if coarse.sum() > room:
                coarse &= weight >= np.partition(weight[coarse], -room)[-room]
            parts = cells[coarse].halved()
            self._likelihood.add(parts, evidence, self._first)
            cells = cells[~coarse].joined(parts)
