"""Memories of scans without an estimator."""

import numpy as np

from taxeld.estimator.estimator import Estimator
from taxeld.estimator.memory import Memory, ObjectSkin, OffsetVariance
from taxeld.estimator.priors import BeliefPrior
from taxeld.estimator.scans import Arrays, Reader, ScanEvidence, scan_arrays
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel


def memory_of(
    model: ObservationModel,
    noise: Noise,
    offsets: OffsetVariance | None = None,
    earlier: BeliefPrior | None = None,
) -> Memory:
    return Memory(ObjectSkin.of(model, noise), offsets or OffsetVariance(), earlier)


def read(memory: Memory, observation: Observation, number: int = 0) -> ScanEvidence:
    return Reader(memory.skin.links, memory.skin.noise).read(observation, number)


def plus(memory: Memory, observation: Observation, number: int = 0, log_z: float = 0.0) -> Memory:
    """The memory with one scan more, of contact `number`."""
    return memory.plus(read(memory, observation, number), log_z)


def remembered(estimator: Estimator) -> Arrays:
    """What a daemon with this estimator hands to its clients."""
    return scan_arrays(estimator.scans) | {"digest": np.array(estimator.digest)}
