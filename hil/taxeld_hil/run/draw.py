"""A session as a picture: all its contacts, or four moments from no touch to the object found."""

import math
from collections.abc import Iterator
from itertools import groupby
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
from taxeld.config import file as config_file
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate, Status
from taxeld.layout.draw import plane
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.source import session
from taxeld.view.stage import truth_of

COLUMNS = 4
MM = 1e3
DPI, NUMBERS, WORDS = 110, 7, 8  # of the picture; sizes of its letters
TRUTH: dict[str, Any] = {"label": "object, true", "color": "black", "lw": 1.2}
FOUND: dict[str, Any] = {"label": "object, estimated", "color": "tab:red", "lw": 1.2, "ls": "--"}
MAYBE: dict[str, Any] = {"label": "object, by each particle", "color": "tab:blue", "lw": 0.8}
LINK: dict[str, Any] = {"label": "link, seen from above", "color": "0.4", "lw": 0.8}
TAXELS: dict[str, Any] = {"cmap": "plasma", "vmin": 0.0, "vmax": 1.0}


class Moment(NamedTuple):
    """What a scan read, and what was believed after it."""

    estimate: Estimate
    z: Floats  # (M,) activations
    sensor: Poses  # (3,) of the link
    particles: Poses  # (N, 3)


class Drawing:
    """A session that is replayed, and what is drawn alike in all its pictures."""

    def __init__(self, directory: Path) -> None:
        """Raises SetupError where the session cannot be used."""
        self._directory = directory
        self._pipeline = open_pipeline(directory, config_file.load(directory / session.CONFIG))
        self._scene = self._pipeline.estimator.model.scene
        self._truth = truth_of(directory / session.TRUTH)
        self.skin: Layout = self._pipeline.skin.layout

    def moments(self) -> Iterator[Moment]:
        """All scans that were used; moments between which the belief stays share its array."""
        particles: Poses = np.zeros((0, 3))
        for outcome in outcomes(self._directory, self._pipeline):
            if outcome.activation is not None and outcome.sensor is not None:
                pose = self._pipeline.estimator.rule.belief.pose
                if not np.array_equal(pose, particles):
                    particles = pose.copy()
                yield Moment(outcome.estimate, outcome.activation.z, outcome.sensor, particles)

    def panel(self, axis: Axes, moment: Moment, span: float, *, estimated: bool = True) -> None:
        """One moment seen from above, `span` sizes of the object to each side of it."""
        angle = np.linspace(0.0, 2.0 * np.pi, 100)
        circle = self.skin.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
        outline = np.vstack([self._scene.outline, self._scene.outline[:1]])
        for pose in moment.particles:
            _line(axis, pose, outline, alpha=0.06, **MAYBE)
        if self._truth is not None:
            _line(axis, self._truth, outline, **TRUTH)
        if estimated:
            _line(axis, moment.estimate.map, outline, **FOUND)
        _line(axis, moment.sensor, circle, **LINK)
        pressed = moment.z > 0.0
        x, y = MM * se2.apply(moment.sensor, self.skin.position_m[pressed, :2]).T
        axis.scatter(x, y, c=moment.z[pressed], s=14, zorder=3, **TAXELS)
        middle = moment.estimate.map if self._truth is None else self._truth
        reach = span * self._scene.size
        axis.set_xlim(MM * (middle[0] - reach), MM * (middle[0] + reach))
        axis.set_ylim(MM * (middle[1] - reach), MM * (middle[1] + reach))
        _label(axis, "x [mm]", "y [mm]")

    def write(self, figure: Figure, out: Path) -> None:
        """With a legend and a colour bar. Raises SetupError where `out` cannot be written."""
        styles = (FOUND, MAYBE, LINK) if self._truth is None else (TRUTH, FOUND, MAYBE, LINK)
        lines = [Line2D([], [], **style) for style in styles]
        figure.legend(handles=lines, loc="outside lower center", ncols=len(lines), fontsize=WORDS)
        colours = ScalarMappable(Normalize(0.0, 1.0), TAXELS["cmap"])
        bar = figure.colorbar(colours, ax=figure.axes, aspect=40)
        bar.set_label("activation of a taxel [full scale]", fontsize=WORDS)
        bar.ax.tick_params(labelsize=NUMBERS)
        save(figure, out)


def draw_contacts(directory: Path, out: Path) -> None:
    """One panel a contact: its deepest moment, and the belief at its end.

    Raises:
        SetupError: the session cannot be used, or holds no contact.
    """
    drawing = Drawing(directory)
    contacts = list(_contacts(drawing.moments()))
    if not contacts:
        raise SetupError(f"{directory}: holds no contact to draw")
    rows = -(-len(contacts) // COLUMNS)
    figure = Figure(figsize=(11, 2.7 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, min(COLUMNS, len(contacts)), squeeze=False)
    for axis in axes.flat[len(contacts) :]:
        axis.set_axis_off()
    for number, (contact, axis) in enumerate(zip(contacts, axes.flat, strict=False), 1):
        drawing.panel(axis, contact, span=2.2)
        axis.set_title(f"contact {number}: {(contact.z > 0.0).sum()} taxels", fontsize=9)
    drawing.write(figure, out)


def _contacts(moments: Iterator[Moment]) -> Iterator[Moment]:
    for contact, scans in groupby(moments, key=lambda moment: moment.estimate.contact):
        if contact:
            deepest = last = next(scans)
            for last in scans:
                deepest = max(deepest, last, key=lambda moment: float(moment.z.max()))
            yield last._replace(z=deepest.z, sensor=deepest.sensor)


def draw_moments(directory: Path, out: Path) -> None:
    """Four moments: above where the object may be, below the unrolled skin.

    Raises:
        SetupError: the session cannot be used, or its object is never found.
    """
    drawing = Drawing(directory)
    shown = four(list(drawing.moments()))
    if shown is None:
        raise SetupError(
            f"{directory}: its object is not found by touch, so its finding is not drawn"
        )
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    axes = figure.subplots(2, 4, height_ratios=(3.6, 1.0), sharex="row", sharey="row")
    for number, (title, moment) in enumerate(shown.items()):
        above, below = axes[:, number]
        drawing.panel(above, moment, span=2.6, estimated=number > 0)
        e = moment.estimate
        likely = (
            f"its likeliest pose: {e.modes[0].weight:.0%}" if e.contacts else "it may be anywhere"
        )
        above.set_title(f"{title}\n{e.status.name.lower()}; {likely}", fontsize=9)
        _unrolled(below, drawing.skin, moment)
        if number:  # the rows share their axes
            above.set_ylabel("")
            below.set_ylabel("")
    drawing.write(figure, out)


def four(moments: list[Moment]) -> dict[str, Moment] | None:
    """The four moments by their titles; None where the object is never found."""
    estimates = [moment.estimate for moment in moments]
    found = next((k for k, e in enumerate(estimates) if e.status == Status.CONVERGED), None)
    touches = [k for k, e in enumerate(estimates) if e.contact]
    if found is None or not touches:
        return None
    number = estimates[touches[0]].contacts
    first = [k for k in touches if estimates[k].contacts == number]
    doubted = [k for k in touches if k < found and estimates[k].contacts > number]
    touched_again = [k for k in touches if k >= found]
    return {
        "before any touch": moments[max(touches[0] - 1, 0)],
        "the first touch": moments[max(first, key=lambda k: float(moments[k].z.sum()))],
        "the next touch begins": moments[min(doubted, default=first[-1])],
        "found": moments[min(touched_again, default=len(moments) - 1)],
    }


def _unrolled(axis: Axes, skin: Layout, moment: Moment) -> None:
    x, z = plane(skin.position_m, skin.radius_m)
    pressed = moment.z > 0.0
    axis.scatter(x, z, s=10, color="0.85")
    axis.scatter(x[pressed], z[pressed], c=moment.z[pressed], s=26, **TAXELS)
    half = math.pi * skin.radius_m * MM
    axis.set_xlim(-1.05 * half, 1.05 * half)
    axis.margins(y=0.15)
    _label(axis, "around the skin [mm]", "z [mm]")


def _label(axis: Axes, x: str, y: str) -> None:
    axis.set_aspect("equal")
    axis.tick_params(labelsize=NUMBERS)
    axis.set_xlabel(x, fontsize=WORDS)
    axis.set_ylabel(y, fontsize=WORDS)


def _line(axis: Axes, pose: Poses, points: Poses, **style: Any) -> None:
    """Points (n, 2) [m] of a frame that stands at a pose (3,)."""
    axis.plot(*(MM * se2.apply(pose, points)).T, **style)


def save(figure: Figure, out: Path) -> None:
    """Raises SetupError where `out` cannot be written."""
    try:
        figure.savefig(out, dpi=DPI)
    except (OSError, ValueError) as error:  # ValueError: the name has no picture's ending
        raise SetupError(f"--out: cannot write {out} ({error})") from None
