"""A session as a picture: the object, where the skin pressed it, how the estimate closed in."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config import file as config_file
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.scene import Scene
from taxeld.pipeline.pipeline import Pipeline
from taxeld.source import session
from taxeld.view.recorded import truth_of

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

COLUMNS = 4
SPAN = 2.2  # half of what a panel shows, in sizes of the object
MM = 1e3
DPI, NUMBERS, WORDS = 110, 7, 8  # of the picture; sizes of its letters
TRUTH: dict[str, Any] = {"color": "black", "lw": 1.2}
FOUND: dict[str, Any] = {"color": "tab:red", "lw": 1.2, "ls": "--"}
MAYBE: dict[str, Any] = {"color": "tab:blue", "lw": 0.8}
LINK: dict[str, Any] = {"color": "0.4", "lw": 0.8}
TAXELS: dict[str, Any] = {"cmap": "plasma", "vmin": 0.0, "vmax": 1.0}


class Moment:
    """What was felt and believed: of a contact its deepest moment, and the belief at its end."""

    def __init__(self) -> None:
        self.deepest = 0.0
        self.sensor: Poses = np.zeros(3)
        self.z: Poses = np.zeros(0)
        self.particles: Poses = np.zeros((0, 3))
        self.map: Poses = np.zeros(3)


def draw(directory: Path, out: Path) -> None:
    """Replay a session and write one panel a contact.

    Raises:
        SetupError: the session cannot be used, or holds no contact.
    """
    pipeline = open_pipeline(directory, config_file.load(directory / session.CONFIG))
    skin, scene = pipeline.skin.layout, pipeline.estimator.model.scene
    truth = truth_of(directory / session.TRUTH)
    contacts = _contacts(directory, pipeline)
    if not contacts:
        raise SetupError(f"{directory}: holds no contact to draw")
    rows = -(-len(contacts) // COLUMNS)
    figure, axes = plt.subplots(
        rows, min(COLUMNS, len(contacts)), figsize=(11, 2.7 * rows + 0.6), squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for axis in axes.flat[len(contacts) :]:
        axis.set_axis_off()
    for number, (contact, axis) in enumerate(zip(contacts, axes.flat, strict=False), 1):
        count = panel(axis, contact, skin, scene, truth)
        axis.set_title(f"contact {number}: {count} taxels", fontsize=9)
    shown = legend(truth is not None)
    figure.legend(handles=shown, loc="outside lower center", ncols=len(shown), fontsize=WORDS)
    activation_bar(figure, axes)
    save(figure, out)


def activation_bar(figure: Figure, axes: NDArray[Any]) -> None:
    bar = figure.colorbar(ScalarMappable(Normalize(0.0, 1.0), TAXELS["cmap"]), ax=axes, aspect=40)
    bar.set_label("activation of a taxel [full scale]", fontsize=WORDS)
    bar.ax.tick_params(labelsize=NUMBERS)


def save(figure: Figure, out: Path) -> None:
    """Raises SetupError where `out` cannot be written."""
    try:
        figure.savefig(out, dpi=DPI)
    except (OSError, ValueError) as error:  # of a name that is no picture's
        raise SetupError(f"--out: cannot write {out} ({error})") from None
    finally:
        plt.close(figure)


def legend(truth: bool) -> list[Line2D]:
    """What the lines of a panel are."""
    kinds = {
        "object, true": TRUTH, "object, estimated": FOUND, "object, by each particle": MAYBE,
        "link, seen from above": LINK,
    }  # fmt: skip
    return [Line2D([], [], label=name, **style)
            for name, style in kinds.items() if truth or style is not TRUTH]  # fmt: skip


def panel(
    axis: Axes, contact: Moment, skin: Layout, scene: Scene, truth: Poses | None,
    span: float = SPAN, *, estimated: bool = True,
) -> int:  # fmt: skip
    """Draw one moment, `span` sizes of the object around it; → how many taxels it pressed."""
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = skin.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    outline = np.vstack([scene.outline, scene.outline[:1]])
    for pose in contact.particles:
        _line(axis, pose, outline, alpha=0.06, **MAYBE)
    if truth is not None:
        _line(axis, truth, outline, **TRUTH)
    if estimated:
        _line(axis, contact.map, outline, **FOUND)
    _line(axis, contact.sensor, circle, **LINK)
    pressed = contact.z > 0.0
    x, y = MM * se2.apply(contact.sensor, skin.position_m[pressed, :2]).T
    axis.scatter(x, y, c=contact.z[pressed], s=14, zorder=3, **TAXELS)
    axis.set_aspect("equal")
    middle = MM * (truth[:2] if truth is not None else contact.map[:2])
    reach = MM * span * scene.size
    axis.set_xlim(middle[0] - reach, middle[0] + reach)
    axis.set_ylim(middle[1] - reach, middle[1] + reach)
    axis.tick_params(labelsize=NUMBERS)
    axis.set_xlabel("x [mm]", fontsize=WORDS)
    axis.set_ylabel("y [mm]", fontsize=WORDS)
    return int(pressed.sum())


def _line(axis: Axes, pose: Poses, points: Poses, **style: Any) -> None:
    """Points (n, 2) [m] of a frame that stands at a pose (3,)."""
    axis.plot(*(MM * se2.apply(pose, points)).T, **style)


def _contacts(directory: Path, pipeline: Pipeline) -> list[Moment]:
    found: list[Moment] = []
    before = False
    for outcome in outcomes(directory, pipeline):
        if outcome.estimate.contact and not before:
            found.append(Moment())
        before = outcome.estimate.contact
        if not before or outcome.activation is None or outcome.sensor is None:
            continue
        contact = found[-1]
        strongest = float(outcome.activation.z.max())
        if strongest > contact.deepest:
            contact.deepest, contact.z = strongest, outcome.activation.z
            contact.sensor = outcome.sensor
        contact.particles = pipeline.estimator.rule.belief.pose.copy()
        contact.map = outcome.estimate.map
    return found
