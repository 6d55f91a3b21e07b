"""A session as a picture: the object, where the skin pressed it, how the estimate closed in."""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from taxeld.arrays import Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config import file as config_file
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.scene import Scene
from taxeld.pipeline.pipeline import Pipeline
from taxeld.source import session

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

COLUMNS = 4


class _Contact:
    """The deepest moment of a contact, and the belief when it ended."""

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
    truth_file = directory / session.TRUTH
    truth = np.array(session.read_poses(truth_file)[-1][1:]) if truth_file.exists() else None
    contacts = _contacts(directory, pipeline)
    if not contacts:
        raise SetupError(f"{directory}: holds no contact to draw")
    rows = -(-len(contacts) // COLUMNS)
    figure, axes = plt.subplots(
        rows, min(COLUMNS, len(contacts)), figsize=(11, 3.1 * rows), squeeze=False
    )
    for axis in axes.flat[len(contacts) :]:
        axis.set_axis_off()
    for number, (contact, axis) in enumerate(zip(contacts, axes.flat, strict=False), 1):
        count = _panel(axis, contact, skin, scene, truth)
        axis.set_title(f"contact {number}: {count} taxels", fontsize=9)
    figure.suptitle("truth black, estimate red, particles blue, sensor grey", fontsize=9)
    figure.tight_layout()
    figure.savefig(out, dpi=80)
    plt.close(figure)


def _panel(axis: Axes, contact: _Contact, skin: Layout, scene: Scene, truth: Poses | None) -> int:
    """Draw one contact; → how many taxels it pressed."""
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = skin.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    outline = np.vstack([scene.outline, scene.outline[:1]])
    for pose in contact.particles:
        axis.plot(*se2.apply(pose, outline).T, color="tab:blue", alpha=0.06, lw=0.8)
    if truth is not None:
        axis.plot(*se2.apply(truth, outline).T, color="black", lw=1.2)
    axis.plot(*se2.apply(contact.map, outline).T, color="tab:red", lw=1.2, ls="--")
    axis.plot(*se2.apply(contact.sensor, circle).T, color="0.4", lw=0.8)
    pressed = contact.z > 0.0
    x, y = se2.apply(contact.sensor, skin.position_m[pressed, :2]).T
    axis.scatter(x, y, c=contact.z[pressed], s=14, cmap="plasma", vmin=0.0, vmax=1.0, zorder=3)
    axis.set_aspect("equal")
    middle = truth[:2] if truth is not None else contact.map[:2]
    reach = 2.2 * scene.size
    axis.set_xlim(middle[0] - reach, middle[0] + reach)
    axis.set_ylim(middle[1] - reach, middle[1] + reach)
    axis.tick_params(labelsize=6)
    return int(pressed.sum())


def _contacts(directory: Path, pipeline: Pipeline) -> list[_Contact]:
    found: list[_Contact] = []
    before = False
    for outcome in outcomes(directory, pipeline):
        if outcome.estimate.contact and not before:
            found.append(_Contact())
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
