"""How good sampled poses are against the truth: their error, and whether their spread is honest.

ADD against the true pose cannot rank samplers: one touch is ambiguous, so even draws of the exact
posterior are far from the truth. The distance to the exact posterior can (`quality`).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model import se2
from taxeld.model.scene import Scene
from taxeld_training.jobs.statistics import of_count, of_median, rounded
from taxeld_training.limits.posterior import embed

LEVEL = 0.9  # share of the samples in a credible region


def summary(
    scene: Scene, truth: Poses, samples: Sequence[Poses], rng: np.random.Generator
) -> dict[str, Any]:
    """Errors of samples (n, 3) of each of the poses `truth` (B, 3).

    `add_mm` as in the paper: the median of all samples, and the best and the worst of a reading's,
    averaged. A `_ci` is the interval of the figure before it, over readings.
    """
    adds = 1e3 * np.array(
        [add(scene, poses, true) for true, poses in zip(truth, samples, strict=True)]
    )
    inside = coverage(truth, samples, scene.size, rng)
    return {
        "add_mm": {
            "median": float(np.median(adds)),
            "best": float(adds.min(axis=1).mean()),
            "worst": float(adds.max(axis=1).mean()),
        },
        "add_mm_ci": rounded(of_median(adds, rng)),
        "coverage_90": float(inside.mean()),
        "coverage_90_ci": rounded(of_count(int(inside.sum()), len(inside))),
        "contacts": len(truth),
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
