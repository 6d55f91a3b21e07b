"""The picture of a recorded skin: its taxels unrolled, and the belief after some touches."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld.arrays import Floats, Poses
from taxeld.model import se2
from taxeld.model.symmetry import add_m
from taxeld_sim.answers import charts
from taxeld_training.evaluation import real

PART, TILT, SEED, AFTER = "head", 0.2, 0, (1, 3, 12)  # of the trial; touches
SHOWN, MARGIN_M = 60, 0.06  # particles; width about the places of the arms and of the part


def draw(folder: Path, path: Path) -> None:
    """Above, the taxels of the first arm; below, as seen from above, the part, the particles and
    the arm's places after some touches."""
    figure = Figure(figsize=(7.0, 5.6), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=[1.0, 1.1])
    arm = next(iter(real.arms_of(folder.resolve()).values()))
    recording = arm.recordings[PART]
    truth, at = recording.drawn(TILT, SEED)
    x, y, z = 1e3 * recording.place.T
    along = 1e3 * float(recording.radius_m) * np.arctan2(y, x)
    axes, on = halves[0].subplots(), recording.on[at[0]]
    shares = axes.scatter(along, z, c=100.0 * arm.skin.share, s=30, vmin=0.0, vmax=100.0)
    (blue, red), about = charts.COLOURS[:2], "answered the first touch"
    axes.scatter(along[on], z[on], s=75, fc="none", ec=red, lw=1.6, label=about)
    halves[0].colorbar(shares, ax=axes, label="presses answered [%]")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    axes.set(aspect="equal", xlabel="round the forearm [mm]", ylabel="along it [mm]")
    panels = halves[1].subplots(1, len(AFTER), sharex=True, sharey=True)
    scene, sensors = arm.known[PART].model.scene, se2.compose(truth, recording.sensors[at])
    rng, turn = np.random.default_rng(0), np.linspace(0.0, 2.0 * np.pi, 60)
    round_arm = float(recording.radius_m) * np.column_stack([np.cos(turn), np.sin(turn)])
    trial = real.followed(arm, (PART, (PART,), TILT, "none", max(AFTER)), SEED)
    for touches, estimator in enumerate(trial, 1):
        if touches in AFTER:
            axes, now = panels[AFTER.index(touches)], estimator.estimate
            belief = estimator.belief.particles
            drawn = belief.pose[rng.choice(len(belief), SHOWN, p=belief.weight)]
            _outlines(axes, scene.outline, drawn, "particles", c=blue, lw=0.4)
            _outlines(axes, round_arm, sensors[:touches], "arms", c="0.6", lw=1.0)
            _outlines(axes, scene.outline, truth[None], f"the {PART}", c="black", lw=1.6)
            off = f"p = {now.p:.2f}, {1e3 * add_m(scene, now.map, truth)[1]:.0f} mm off"
            axes.set_title(f"touches: {touches}\n{off}", fontsize=9)
            axes.set(aspect="equal", xlabel="x [mm]")
    places = np.vstack([sensors[: max(AFTER)], truth])[:, :2]
    (left, low), (right, high) = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    panels[0].set(ylabel="y [mm]", xlim=(1e3 * left, 1e3 * right), ylim=(1e3 * low, 1e3 * high))
    named = panels[0].get_legend_handles_labels()
    halves[1].legend(*named, loc="outside lower center", ncols=3, frameon=False)
    charts.save(figure, path)


def _outlines(axes: Axes, line: Floats, poses: Poses, about: str, **style: Any) -> None:
    """The closed outline (n, 2) at poses (K, 3)."""
    placed_mm = 1e3 * np.array([se2.apply(pose, np.vstack([line, line[:1]])) for pose in poses])
    axes.plot(*placed_mm.T, **style)[0].set_label(about)
