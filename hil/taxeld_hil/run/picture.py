"""A session as a picture: four moments, from no touch to the object found."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from taxeld.arrays import Floats, Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.errors import SetupError, WorkError
from taxeld.estimator.estimate import Estimate, Status
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.scene import Scene
from taxeld.pipeline.pipeline import Pipeline
from taxeld.source import session

MM = 1e3
DPI, NUMBERS, WORDS = 110, 7, 8  # dots per inch; sizes of letters
SPAN = 2.6  # sizes of the object that are shown to each side of it
TRUTH: dict[str, Any] = {"label": "object, true", "color": "black", "lw": 1.2}
FOUND: dict[str, Any] = {"label": "object, estimated", "color": "tab:red", "lw": 1.2, "ls": "--"}
MAYBE: dict[str, Any] = {"label": "object, by each particle", "color": "tab:blue", "lw": 0.8}
LINK: dict[str, Any] = {"label": "link, seen from above", "color": "0.4", "lw": 0.8}
TAXELS: dict[str, Any] = {"cmap": "plasma", "vmin": 0.0, "vmax": 1.0}


class DrawnScan(NamedTuple):
    """The readings of a scan of M taxels, and the estimate after it."""

    estimate: Estimate
    z: Floats  # (M,) activations
    sensor: Poses  # (3,) of the link
    particles: Poses  # (N, 3)


def draw(directory: Path, out: Path) -> None:
    """Four moments, each above the unrolled skin.

    Raises:
        WorkError: its object is not found.
        SetupError: the session cannot be used, or `out` cannot be written.
    """
    pipeline = open_pipeline(directory, session.config_of(directory))
    shown = four(list(_scans(directory, pipeline)))
    if not shown:
        raise WorkError(
            f"{directory}: its object is not found by touch; see it by taxeld view {directory}"
        )
    skin, known = pipeline.skin.layout, pipeline.estimator.known
    truth = session.truth(directory) if len(known) == 1 else None  # of which one, is not known
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    above, below = figure.subplots(2, 4, height_ratios=(3.6, 1.0), sharex="row", sharey="row")
    for (title, scan), one, other in zip(shown.items(), above, below, strict=True):
        _from_above(one, scan, known[scan.estimate.object].model.scene, skin, truth)
        _unrolled(other, scan, skin)
        one.set_title(title, fontsize=9)
    for row, x, y in ((above, "x [mm]", "y [mm]"), (below, "around the skin [mm]", "z [mm]")):
        for axis in row:
            axis.set_aspect("equal")
            axis.tick_params(labelsize=NUMBERS)
            axis.set_xlabel(x, fontsize=WORDS)
        row[0].set_ylabel(y, fontsize=WORDS)
    styles = [FOUND, MAYBE, LINK] if truth is None else [TRUTH, FOUND, MAYBE, LINK]
    lines = [Line2D([], [], **style) for style in styles]
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), fontsize=WORDS)
    colours = ScalarMappable(Normalize(0.0, 1.0), TAXELS["cmap"])
    bar = figure.colorbar(colours, ax=figure.axes, aspect=40)
    bar.set_label("activation of a taxel [full scale]", fontsize=WORDS)
    bar.ax.tick_params(labelsize=NUMBERS)
    save(figure, out)


def _scans(directory: Path, pipeline: Pipeline) -> Iterator[DrawnScan]:
    """All scans that were used; scans between which the belief stays share its array."""
    particles: Poses = np.zeros((0, 3))
    for outcome in outcomes(directory, pipeline):
        if outcome.activation is not None and outcome.sensor is not None:
            pose = pipeline.estimator.rule.belief.pose
            if not np.array_equal(pose, particles):
                particles = pose.copy()
            yield DrawnScan(outcome.estimate, outcome.activation.z, outcome.sensor, particles)


def four(scans: list[DrawnScan]) -> dict[str, DrawnScan]:
    """The four moments by their titles; none where the object is never found."""
    estimates = [scan.estimate for scan in scans]
    found = next((k for k, e in enumerate(estimates) if e.status == Status.CONVERGED), None)
    touches = [k for k, e in enumerate(estimates) if e.contact]
    if found is None or not touches:
        return {}
    number = estimates[touches[0]].contacts
    first = [k for k in touches if estimates[k].contacts == number]
    doubted = [k for k in touches if k < found and estimates[k].contacts > number]
    touched_again = [k for k in touches if k >= found]
    chosen = {
        "before any touch": scans[max(touches[0] - 1, 0)],
        "the first touch": scans[max(first, key=lambda k: float(scans[k].z.sum()))],
        "the next touch begins": scans[min(doubted, default=first[-1])],
        "found": scans[min(touched_again, default=len(scans) - 1)],
    }
    return {f"{name}\n{_belief(scan.estimate)}": scan for name, scan in chosen.items()}


def _belief(e: Estimate) -> str:
    likely = f"its likeliest pose: {e.p:.0%}" if e.contacts else "it may be anywhere"
    return f"{e.status.name.lower()}; {likely}"


def _from_above(
    axis: Axes, scan: DrawnScan, scene: Scene, skin: Layout, truth: Poses | None
) -> None:
    """The link, its pressed taxels and the object; `truth` (3,) where it is known."""
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    gap = np.full((1, 2), np.nan)  # no line leads from one part to another
    outline = np.vstack([part for one in scene.outlines for part in (one, one[:1], gap)])
    for pose in scan.particles:
        _line(axis, pose, outline, alpha=0.06, **MAYBE)
    if truth is not None:
        _line(axis, truth, outline, **TRUTH)
    if scan.estimate.contacts:
        _line(axis, scan.estimate.map, outline, **FOUND)
    circle = skin.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    _line(axis, scan.sensor, circle, **LINK)
    pressed = scan.z > 0.0
    x, y = MM * se2.apply(scan.sensor, skin.position_m[pressed, :2]).T
    axis.scatter(x, y, c=scan.z[pressed], s=14, zorder=3, **TAXELS)
    middle, reach = scan.estimate.map if truth is None else truth, SPAN * scene.size
    axis.set_xlim(MM * (middle[0] - reach), MM * (middle[0] + reach))
    axis.set_ylim(MM * (middle[1] - reach), MM * (middle[1] + reach))


def _unrolled(axis: Axes, scan: DrawnScan, skin: Layout) -> None:
    """The pressed taxels on the unrolled skin."""
    x, z = MM * skin.unrolled_m
    pressed = scan.z > 0.0
    axis.scatter(x, z, s=10, color="0.85")
    axis.scatter(x[pressed], z[pressed], c=scan.z[pressed], s=26, **TAXELS)
    half = math.pi * skin.radius_m * MM
    axis.set_xlim(-1.05 * half, 1.05 * half)
    axis.margins(y=0.15)


def _line(axis: Axes, pose: Poses, points: Poses, **style: Any) -> None:
    """Points (n, 2) [m] of a frame that stands at a pose (3,)."""
    axis.plot(*(MM * se2.apply(pose, points)).T, **style)


def save(figure: Figure, out: Path) -> None:
    """Write a figure. Raises SetupError where `out` cannot be written."""
    try:
        figure.savefig(out, dpi=DPI)
    except (OSError, ValueError) as error:  # ValueError: the name has no picture's ending
        raise SetupError(f"--png: cannot write {out} ({error})") from None
