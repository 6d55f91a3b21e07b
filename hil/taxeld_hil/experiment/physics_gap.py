"""How far a soft skin's readings lie from what the estimator expects, and by which effect.

Random contacts are pressed a scan at a time, held and let go by a scan; each effect is added to
those before it, and readings are compared with h of the same pose. All in activations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.layout.layout import Layout
from taxeld.model import contacts
from taxeld.model.observation import Noise, ObservationModel
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.electronics import CrossTalk, Response
from taxeld_hil.world.foam import Foam
from taxeld_hil.world.mesh_skin import MeshSkin
from taxeld_hil.world.solids import Solid
from taxeld_hil.world.spread import PerPress, drawn

STEP_M = 0.001  # a scan's, of a press at 20 mm/s
SCAN_S = 0.05
HELD_SCANS = 6
TOUCH = 0.01  # activations below are none, as for the daemon (skin.py)
STAGES = (
    "3-D distance", "electrode's area", "sag", "response", "foam", "gains", "cross-talk", "counts",
)  # fmt: skip
BINS = np.arange(6) * 0.001  # depths
EXPECTED = np.linspace(0.0, 1.0, 11)
SIGMAS = np.geomspace(0.005, 0.2, 30)
CVS = np.linspace(0.0, 0.8, 41)

Progress = Callable[[int], None]


class ContactReadings(NamedTuple):
    """Of n contacts, each while it is held and when it recedes: 2 n rows."""

    expected: Floats  # (2 n, M)
    read: Floats  # (stages, 2 n, M)
    depth_m: Floats  # (2 n,)
    receding: Floats  # (2 n,) 0 or 1


@dataclass(frozen=True)
class SkinComparison:
    """A skin of three kinds against one solid: hard, hard with electrodes, soft."""

    scenario: Scenario
    model: ObservationModel
    solid: Solid

    def readings(self, n: int, rng: np.random.Generator, progress: Progress) -> ContactReadings:
        layout, config = self.model.layout, self.scenario.skin
        point = MeshSkin(self.solid, layout, 0.0, sags=False)
        wide = MeshSkin(self.solid, layout, config.taxel_radius_m)
        hard = np.zeros(len(layout))
        touches = _touches(self.model, n, rng)
        expected, read = [], []
        for done, (pose, depth) in enumerate(zip(*touches, strict=True), 1):
            sag_m = PerPress(config.sag_m, len(layout), rng).now
            way = np.append(np.arange(-STEP_M, depth, STEP_M), [depth, depth - STEP_M])
            along = contacts.project(
                self.model.scene, layout.radius_m, np.tile(pose, (len(way), 1)), way
            )[0]
            skins = ((point, hard), (wide, hard), (wide, sag_m))
            deep = np.array([[skin.indentation(p, sag) for p in along] for skin, sag in skins])
            expected.append(self.model.activation(along[-2:]))
            read.append(self._stages(deep / self.model.depth_max_m, rng))
            progress(done)
        return ContactReadings(
            expected=np.concatenate(expected),
            read=np.concatenate(read, axis=1),
            depth_m=(touches[1][:, None] - [0.0, STEP_M]).ravel(),
            receding=np.tile([0.0, 1.0], n),
        )

    def _stages(self, h: Floats, rng: np.random.Generator) -> Floats:
        """(stages, 2, M) of depths (3, steps, M): at the last of the hold, and a step back; every
        contact has a skin of its own."""
        config, taxels, full = self.scenario.skin, h.shape[2], self.scenario.full_scale_counts
        gain = np.maximum(1.0 + config.gain_cv * rng.standard_normal(taxels), 0.1)
        foam = Foam(config, taxels, rng)
        bent = Response(config, taxels, rng)(h[2])
        steps = len(bent) - 1
        for k in range(steps + HELD_SCANS):
            held = foam.press(bent[min(k, steps - 1)], SCAN_S * k)
        soft = np.stack([held, foam.press(bent[-1], SCAN_S * (steps + HELD_SCANS))])
        apart = gain * soft
        cross_talk = CrossTalk(self.model.layout, config.cross_talk, rng)
        mixed = np.stack([cross_talk.add(row) for row in apart])
        noise = drawn(config.noise_counts, rng.standard_normal(taxels)) / full
        noisy = mixed + noise * rng.standard_normal(mixed.shape)
        counted = np.round(noisy * full) / full
        kept = np.where(counted > np.maximum(TOUCH, 6.0 * noise), counted, 0.0)
        stages = [h[0, -2:], h[1, -2:], h[2, -2:], bent[-2:], soft, apart, mixed, kept]
        return np.asarray(np.clip(np.stack(stages), 0.0, 1.0))


def compare(readings: ContactReadings, layout: Layout, noise: Noise) -> dict[str, Any]:
    """What `SkinComparison.readings` amount to, for JSON."""
    expected, read = readings.expected, readings.read
    stages = []
    before = expected
    for name, z in zip(STAGES, read, strict=True):
        touched = (expected > TOUCH) | (z > TOUCH)
        step = np.sqrt(np.mean((z - before)[touched] ** 2))
        stages.append({"stage": name, **_figures(z, expected, touched), "step_rms": float(step)})
        before = z
    last = read[-1]
    touched = (expected > TOUCH) | (last > TOUCH)
    rows = np.unique(layout.position_m[:, 2])
    row = np.searchsorted(rows, layout.position_m[:, 2])
    bins = np.digitize(readings.depth_m, BINS) - 1
    return {
        "stages": stages,
        "rms_by_depth": [
            {"depth_mm": [k, k + 1], **_by_stage(read[:, bins == k], expected[bins == k])}
            for k in range(len(BINS) - 1)
        ],
        "by_row": [
            {"z_mm": 1e3 * z, **_figures(last, expected, touched & (row == k))}
            for k, z in enumerate(rows)
        ],
        "read_by_expected": _spread(last, expected),
        "held": _figures(last, expected, touched & (readings.receding == 0.0)[:, None]),
        "receding": _figures(last, expected, touched & (readings.receding == 1.0)[:, None]),
        "felt_unexpected": float(np.mean(np.sum((expected <= 0.0) & (last > 0.0), axis=1))),
        "expected_unfelt": float(np.mean(np.sum((expected > TOUCH) & (last <= 0.0), axis=1))),
        "expected_felt": float(np.mean(np.sum((expected > TOUCH) & (last > 0.0), axis=1))),
        "noise": _noise_fit(last[touched], expected[touched], noise),
        "noise_without_gains": _noise_fit(*_both(read[STAGES.index("foam")], expected), noise),
    }


def _touches(model: ObservationModel, n: int, rng: np.random.Generator) -> tuple[Poses, Floats]:
    found = contacts.synthesise(
        model.scene, model.layout.radius_m, model.depth_max_m, 2 * n + 20, rng
    )
    active = np.flatnonzero(model.activation(found.pose).max(axis=1) > TOUCH)[:n]
    return found.pose[active], found.depth_m[active]


def _figures(z: Floats, h: Floats, of: Any) -> dict[str, float]:
    gap = (z - h)[of]
    if len(gap) < 3:
        return {"taxels": len(gap)}
    return {
        "taxels": len(gap),
        "bias": float(gap.mean()),
        "sd": float(gap.std()),
        "rms": float(np.sqrt(np.mean(gap**2))),
        "median_abs": float(np.median(np.abs(gap))),
        "p99_abs": float(np.quantile(np.abs(gap), 0.99)),
        "correlation": float(np.corrcoef(z[of], h[of])[0, 1]),
    }


def _spread(z: Floats, h: Floats) -> list[dict[str, float]]:
    """Where nine in ten readings lie, by what was expected. The first row is of taxels that read
    something where nothing was expected."""
    rows = []
    for low, high in [(-1.0, 0.0), *pairwise(EXPECTED)]:
        mine = z[(h > low) & (h <= high) & ((h > 0.0) | (z > 0.0))]
        if len(mine) > 20:
            q05, median, q95 = np.quantile(mine, (0.05, 0.5, 0.95))
            middle = max(0.5 * (low + high), 0.0)
            rows.append({"expected": middle, "q05": q05, "median": median, "q95": q95})
    return rows


def _by_stage(read: Floats, expected: Floats) -> dict[str, float]:
    both = (_both(z, expected) for z in read)
    return {
        name: float(np.sqrt(np.mean((z - h) ** 2))) if len(z) else 0.0
        for name, (z, h) in zip(STAGES, both, strict=True)
    }


def _both(z: Floats, h: Floats) -> tuple[Floats, Floats]:
    touched = (h > TOUCH) | (z > TOUCH)
    return z[touched], h[touched]


def _noise_fit(z: Floats, h: Floats, noise: Noise) -> dict[str, Any]:
    """Readings (n,) against the noise that is assumed, and the one that explains them best."""

    def log_density(sigma: float, cv: float) -> float:
        return float(Noise(sigma, cv, noise.outliers).log_density(z, h).mean())

    odd = np.abs(z - h) / np.sqrt(noise.sigma**2 + (noise.gain_cv * h) ** 2)
    best = max((log_density(s, c), s, c) for s in SIGMAS for c in CVS)
    return {
        "assumed": {"sigma": noise.sigma, "gain_cv": noise.gain_cv,
                    "log_density": log_density(noise.sigma, noise.gain_cv)},
        "best": {"sigma": float(best[1]), "gain_cv": float(best[2]), "log_density": best[0]},
        "rms_in_sd": float(np.sqrt(np.mean(odd**2))),
        "median_in_sd": float(np.median(odd)),
        "over_3_sd": float(np.mean(odd > 3.0)),
        "over_3_sd_unexpected": float(np.mean((odd > 3.0) & (h <= TOUCH))),
    }  # fmt: skip
