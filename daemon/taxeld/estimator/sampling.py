"""Samples for a rule: from the proposal, in the sensor's frame, into the world."""

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator import injection
from taxeld.estimator.estimate import ProposalKind
from taxeld.model import se2
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.proposal import Proposal

__all__ = ["Proposal", "Sampling"]


class Sampling:
    """A proposal as the `draw` of `estimator.rule`."""

    def __init__(
        self, model: ObservationModel, proposal: Proposal, rng: np.random.Generator
    ) -> None:
        self.kind = ProposalKind.NONE  # kind of the last samples
        self._model, self._proposal, self._rng = model, proposal, rng

    def __call__(self, observation: Observation, n: int) -> Poses:
        """At most n poses (≤ n, 3) in the world that explain an observation by itself."""
        poses = self._proposal.propose(observation.z, observation.live, n, self._rng)
        poses = poses[np.isfinite(poses).all(axis=1)]
        if not len(poses):
            return poses
        poses = injection.project(self._model, poses)  # those that miss the object, by one step
        self.kind = ProposalKind[self._proposal.name.upper()]
        return se2.compose(observation.sensor, poses)
