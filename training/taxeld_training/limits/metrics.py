"""How good sampled poses are: against the truth, the contact, the reading and the posterior.

Plain ADD against the true pose cannot rank samplers: one touch is ambiguous, so even draws of the
exact posterior are far from the truth. The distance to the exact posterior can. Both are kept.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import Scene
from taxeld_training.jobs.statistics import of_mean, of_median, of_share, rounded
from taxeld_training.limits.posterior import embed

FEW = 10  # samples of a reading, drawn from all of them, for the error that is costly
LEVEL = 0.9  # share of the samples in a credible region


def summary(
    model: ObservationModel, z: Floats, truth: Poses, samples: Sequence[Poses],
    rng: np.random.Generator,
) -> dict[str, Any]:  # fmt: skip
    """Errors over readings z (B, M) of poses `truth` (B, 3), each with samples (n, 3).

    `add_mm` as in the paper: the median of all samples, and the best and the worst of a reading's,
    averaged. The symmetric ADD is the median over FEW samples of a reading; a sampler may give its
    samples in order, so the few are drawn. A `_ci` is the interval of the figure before it, over
    readings.
    """
    each = list(zip(truth, samples, strict=True))
    adds = 1e3 * np.array([add(model.scene, poses, true) for true, poses in each])
    few = [rng.permutation(poses)[:FEW] for poses in samples]
    symmetric = [add_symmetric(model.scene, a, true) for a, true in zip(few, truth, strict=True)]
    add_sym = 1e3 * np.array(symmetric)
    contact = 1e3 * np.array([contact_residual(model, poses, true).mean() for true, poses in each])
    observation = np.array([
        np.abs(model.activation(poses) - reading).max(axis=1).mean()
        for reading, poses in zip(z, samples, strict=True)
    ])  # fmt: skip
    inside = coverage(truth, samples, model.scene.size, rng)
    return {
        "add_mm": {
            "median": float(np.median(adds)),
            "best": float(adds.min(axis=1).mean()),
            "worst": float(adds.max(axis=1).mean()),
        },
        "add_mm_ci": rounded(of_median(adds, rng)),
        "add_sym_mm": float(np.median(add_sym)),
        "add_sym_mm_ci": rounded(of_median(add_sym, rng)),
        "contact_residual_mm": float(contact.mean()),
        "contact_residual_mm_ci": rounded(of_mean([contact], rng)),
        "observation_residual": float(observation.mean()),
        "observation_residual_ci": rounded(of_mean([observation], rng)),
        "coverage_90": float(inside.mean()),
        "coverage_90_ci": rounded(of_share(inside.tolist())),
        "contacts": len(z),
    }


def coverage(
    truth: Poses, samples: Sequence[Poses], length_m: float, rng: np.random.Generator
) -> Bools:
    """(B,) which truths (B, 3) are inside the LEVEL credible region of their samples (n, 3): LEVEL
    of them if calibrated.

    Regions are balls about a random other truth (TARP, Lemos et al. 2023). This finds samples that
    are too narrow, too wide or biased anywhere in the prior.
    """
    inside = []
    for i, (true, drawn) in enumerate(zip(truth, samples, strict=True)):
        j = (i + int(rng.integers(1, len(truth)))) % len(truth) if len(truth) > 1 else i
        about = embed(truth[j : j + 1], length_m)
        to_truth = np.linalg.norm(embed(true[None], length_m) - about)
        nearer = np.linalg.norm(embed(drawn, length_m) - about, axis=1) < to_truth
        inside.append(nearer.mean() < LEVEL)
    return np.array(inside)


def add(scene: Scene, poses: Poses, truth: Poses) -> Floats:
    """ADD (n,) [m]: mean distance of surface points at poses (n, 3) from those at `truth` (3,)."""
    x, y = scene.surface[:, :2].T
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    placed = np.stack([poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y], axis=2)
    gap = placed - se2.apply(truth, scene.surface[:, :2])
    return np.asarray(np.linalg.norm(gap, axis=2).mean(axis=1))


def add_symmetric(scene: Scene, poses: Poses, truth: Poses) -> Floats:
    """The least ADD (n,) [m] of poses (n, 3) to any pose that touch cannot tell from `truth`
    (3,)."""
    equivalent = se2.compose(truth, scene.equivalents)
    return np.asarray(np.min([add(scene, poses, pose) for pose in equivalent], axis=0))


def contact_residual(model: ObservationModel, poses: Poses, truth: Poses) -> Floats:
    """(n,) [m] how much deeper or less deep poses (n, 3) press the skin than `truth` (3,) does."""
    radius_m = model.layout.radius_m
    pressed = contacts.clearance(model.scene, radius_m, truth[None])
    return np.asarray(np.abs(contacts.clearance(model.scene, radius_m, poses) - pressed))
