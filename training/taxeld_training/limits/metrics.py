"""How good sampled poses are: against the truth, the contact, the reading and the posterior.

Plain ADD against the true pose cannot rank samplers: one touch is ambiguous, so even draws of the
exact posterior are far from the truth. The distance to the exact posterior can. Both are kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import Scene
from taxeld_training.jobs.statistics import of_mean, of_median, of_share, rounded
from taxeld_training.limits.posterior import embed

FEW = 10  # samples of a reading, drawn from all of them, for the errors that are costly
LEVEL = 0.9  # of a credible region


@dataclass(frozen=True, slots=True)
class SampleErrors:
    """Of n samples of one reading; lengths in mm."""

    add_mm: Floats  # (n,) average distance of surface points (the paper's)
    add_sym_mm: Floats  # (FEW,) the least over the object's geometric rotation group
    add_s_mm: Floats  # (FEW,) to the nearest point of the true surface
    contact_residual_mm: Floats  # (n,) |σ + δ|: difference of the pressed depth
    observation_residual: Floats  # (n,) max over taxels |h(q) − z|


def sample_errors(
    model: ObservationModel, z: Floats, truth: Poses, poses: Poses, rng: np.random.Generator
) -> SampleErrors:
    """Errors of poses (n, 3) sampled for a reading z (M,) of the pose `truth` (3,), all in the
    sensor frame. A sampler may give its samples in order, so the few are drawn."""
    radius_m = model.layout.radius_m
    few = rng.permutation(poses)[:FEW]
    pressed = contacts.clearance(model.scene, radius_m, truth[None])
    residual = np.abs(contacts.clearance(model.scene, radius_m, poses) - pressed)
    return SampleErrors(
        add_mm=1e3 * add(model.scene, poses, truth),
        add_sym_mm=1e3 * add_symmetric(model.scene, few, truth),
        add_s_mm=1e3 * add_s(model.scene, few, truth),
        contact_residual_mm=1e3 * residual,
        observation_residual=np.abs(model.activation(poses) - z).max(axis=1),
    )


def summary(
    model: ObservationModel, z: Floats, truth: Poses, samples: Sequence[Poses],
    rng: np.random.Generator,
) -> dict[str, Any]:  # fmt: skip
    """Errors over readings z (B, M) of poses `truth` (B, 3), each with samples (n, 3).

    `add_mm` as in the paper: the median of all samples, and the best and the worst of a reading's,
    averaged. ADD-S and the symmetric ADD are medians over FEW samples of a reading. A `_ci` is the
    interval of the figure before it, over readings.
    """
    each = [sample_errors(model, *one, rng) for one in zip(z, truth, samples, strict=True)]
    adds = np.array([e.add_mm for e in each])
    add_s = np.array([e.add_s_mm for e in each])
    add_sym = np.array([e.add_sym_mm for e in each])
    contact = np.array([e.contact_residual_mm.mean() for e in each])
    observation = np.array([e.observation_residual.mean() for e in each])
    inside = coverage(truth, samples, model.scene.size, rng)
    return {
        "add_mm": {
            "median": float(np.median(adds)),
            "best": float(adds.min(axis=1).mean()),
            "worst": float(adds.max(axis=1).mean()),
        },
        "add_mm_ci": rounded(of_median(adds, rng)),
        "add_s_mm": float(np.median(add_s)),
        "add_s_mm_ci": rounded(of_median(add_s, rng)),
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
    """(B,) which truths (B, 3) are inside their samples' LEVEL credible region: LEVEL of them if
    calibrated.

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
    gap = place(poses, scene.surface[:, :2]) - se2.apply(truth, scene.surface[:, :2])
    return np.asarray(np.linalg.norm(gap, axis=2).mean(axis=1))


def add_symmetric(scene: Scene, poses: Poses, truth: Poses) -> Floats:
    """The least ADD (n,) [m] to any pose that touch cannot tell from `truth`."""
    equivalent = se2.compose(truth, scene.equivalents)
    return np.asarray(np.min([add(scene, poses, pose) for pose in equivalent], axis=0))


def add_s(scene: Scene, poses: Poses, truth: Poses) -> Floats:
    """ADD-S (n,) [m]: mean distance of surface points to the nearest of those at `truth`."""
    z = scene.surface[:, 2]
    tree = cKDTree(np.column_stack([se2.apply(truth, scene.surface[:, :2]), z]))
    placed = place(poses, scene.surface[:, :2])
    points = np.concatenate([placed, np.broadcast_to(z[:, None], (*placed.shape[:2], 1))], axis=2)
    return np.asarray(tree.query(points)[0].mean(axis=1))


def place(poses: Poses, points: Floats) -> Floats:
    """Points (Q, 2) of the object at poses (n, 3) → (n, Q, 2)."""
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x, y = points.T
    return np.stack([poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y], axis=2)
