"""Advice: what a touch along each of some approaches would tell, in nats.

Each place that the belief holds possible is taken for the true one in turn. The touch has an
outcome, which is how far the link gets and what it then reads, or that nothing is felt, and by
which the places are weighed. It tells as many nats as it is expected to make the true one likelier.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from taxeld.advice.candidates import Candidate, depth_m, way_until_felt
from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld.estimator.estimator import Estimator
from taxeld.model import se2
from taxeld.model.observation import Observation
from taxeld.model.symmetry import Mode

MOST = 1000  # candidates: some milliseconds each
PLACES = 40  # at most
WAY_SD_M = 0.002  # foam, shape and robot make a touch come so much sooner or later
FAR_M = 1e3  # way to a touch that is not felt
TEMPER = 0.1  # power of a reading's likelihood: foam has its taxels err together
LEAST = -8.0  # nats: least log-likelihood of a way or of a reading, as nothing is certain


@dataclass(frozen=True, slots=True)
class TouchMemory:
    """What was felt: an estimator that has learned it, and each link's mount, None as the robot
    says."""

    estimator: Estimator
    mounts: Sequence[Poses | None] = ()


@dataclass(frozen=True, slots=True)
class Advised:
    """A candidate, and what a touch there would tell."""

    candidate: Candidate
    nats: float  # expected rise of the log probability of the true place
    p_touch: float  # probability that the skin feels anything
    free_m: float  # way from the begin to the nearest likely touch


def advise(memory: TouchMemory, candidates: Sequence[Candidate]) -> list[Advised]:
    """The candidates, of which a touch would tell most first.

    Raises:
        SetupError: there are too many, or the estimator has the paper's rule, which remembers
            nothing.
    """
    if memory.estimator.config.injection == "paper":
        raise SetupError("advice: needs the memory of filter.injection = 'mixture'")
    if len(candidates) > MOST:
        raise SetupError(f"candidates: must be at most {MOST}, not {len(candidates)}")
    found = places(memory.estimator)
    told = [_advised(memory, found, each) for each in candidates]
    return sorted(told, key=lambda each: -each.nats)


def places(estimator: Estimator) -> list[Mode]:
    """Where the belief has the objects: poses apart by half of what a sure estimate may be off."""
    bank, found = estimator.bank, list[Mode]()
    for k in bank.likely:
        particles, metric = bank.beliefs[k].particles, bank.beliefs[k].metric
        apart_m, share = 0.5 * estimator.config.within_m, float(bank.odds.objects[k])
        modes = metric.modes(particles.pose, particles.weight, apart_m, PLACES, len(particles))
        found += [replace(mode, weight=share * mode.weight, object=k) for mode in modes]
    return sorted(found, key=lambda mode: -mode.weight)[:PLACES]


def _advised(memory: TouchMemory, of: Sequence[Mode], candidate: Candidate) -> Advised:
    """What a touch along a candidate would tell of K places."""
    estimator, mount = memory.estimator, memory.mounts[candidate.link] if memory.mounts else None
    along, like = candidate if mount is None else candidate.of(mount), _like(estimator, candidate)
    weight = np.array([place.weight for place in of])
    weight /= weight.sum()
    number, pose = np.array([place.object for place in of]), np.array([p.pose for p in of])
    way_m, sensor, z = np.empty(len(of)), np.empty((len(of), 3)), np.empty((len(of), len(like.z)))
    for k in set(number.tolist()):
        own, link = number == k, estimator.known[k].model.links[candidate.link]
        way_m[own] = way_until_felt(along, link, pose[own])
        sensor[own] = along.after(np.minimum(way_m[own], along.length_m) + depth_m(link))
        z[own] = link.activation(se2.compose(se2.inverse(sensor[own]), pose[own]))
    z *= (z >= like.floor) & like.live & np.isfinite(way_m)[:, None]
    felt = z.any(axis=1)
    far, read = np.where(felt, way_m, FAR_M), np.zeros((len(of), len(of)))  # (truth, place)
    for k in set(number.tolist()) if felt.any() else ():
        own, belief = number == k, estimator.bank.beliefs[k]
        read[np.ix_(felt, own)] = belief.memory.foreseen(like, z[felt], sensor[felt], pose[own]).T
    told = np.maximum(-0.5 * np.square((far[:, None] - far) / WAY_SD_M), LEAST)
    told += np.maximum(TEMPER * (read - read.max(axis=1, keepdims=True)), LEAST)
    right = np.diag(told) - np.log(np.exp(told) @ weight)  # log of how much likelier the truth is
    free_m = min(float(way_m.min()), along.length_m)
    return Advised(candidate, float(weight @ right), float(weight @ felt), free_m)


def _like(estimator: Estimator, candidate: Candidate) -> Observation:
    """A scan of its link: the last one that is remembered, or else what its skin is known for."""
    for scan in reversed(estimator.scans):
        if scan.observation.link == candidate.link:
            return scan.observation
    taxels = len(estimator.model.links[candidate.link].layout)
    silent = np.zeros(taxels), np.ones(taxels, np.bool_)
    return Observation(se2.IDENTITY, *silent, link=candidate.link)
