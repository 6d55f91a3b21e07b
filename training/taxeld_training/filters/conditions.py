"""Conditions of a trial: how skin, robot and world differ from what the estimator assumes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.noise import FLOOR
from taxeld.model.observation import Activation, ObservationModel
from taxeld.skin.foam import Residue
from taxeld_hil.scenario.mesh_config import SKINS, MeshConfig
from taxeld_hil.world.soft_skin import CrossTalk, Foam, PerPress, Response, drawn
from taxeld_training.models.dataset import SILENT

MODULE = 10  # taxels of a module
SIDE_RAD = np.pi / 4.0  # a side reaches this far in both directions
NUDGE_RAD = np.pi / 6.0  # largest angle between a nudge and the contact's normal: friction
TWIN_GAP_M = 0.01  # gap between the object and the one beside it
TWIN_STEP_M = 0.002  # step of the search for that gap
SOFT_SILENT = 6.0  # standard deviations of a soft skin's noise: less is no touch to a daemon

Accepts = Callable[[Poses], Bools]  # poses (N, 3) → which of them may be used (N,)


@dataclass(frozen=True)
class TrialConditions:
    """The conditions of a trial; the defaults are what the estimator assumes."""

    sigma: float = 0.02  # sd of an activation
    gain_cv: float = 0.17  # spread of the taxels' gains
    dead_share: float = 0.0  # share of scattered taxels that are known to be dead
    dead_modules: int = 0  # runs of ten taxels, known to be dead
    stuck: int = 0  # taxels that always read `stuck_at`, not known to
    stuck_at: float = 1.0
    drift: float = 0.0  # largest drift of a baseline by the last touch, up or down
    depth: float = 1.0  # the deepest press, in δ_max
    sensor_sd_m: float = 0.0  # error of the reported sensor pose, drawn anew each touch
    sensor_sd_rad: float = 0.0
    kidnapped_after: int = 0  # the object is put elsewhere after so many touches; 0: never
    pushed_m: float = 0.0  # way of the object between two touches, all along one line
    pushed_rad: float = 0.0
    nudged_m: float = 0.0  # about how far each press moves the object away from the skin
    both: int = 0  # touches that press a second object of the same kind, beside it, as well
    one_side: bool = False  # all touches come from one quarter of the directions
    skin: str = ""  # a soft skin of the harness: its gains and noise in place of these
    scans: int = 5  # scans of a press while it is held
    slip_m: float = 0.0  # sd of the sensor's place in each of these scans

    def gains(self, taxels: int, rng: np.random.Generator) -> Floats:
        """(M,) of a skin's taxels."""
        cv = SKINS[self.skin].gain_cv if self.skin else self.gain_cv
        return np.maximum(1.0 + cv * rng.standard_normal(taxels), 0.1)


class TrialSkin:
    """The skin of one trial: its gains and faults last throughout."""

    def __init__(
        self, given: TrialConditions, layout: Layout, gain: Floats, rng: np.random.Generator
    ) -> None:
        """`gain` (M,) of each taxel."""
        taxels = len(gain)
        self._given = given
        self._gain = gain
        self._offset = given.drift * rng.uniform(-1.0, 1.0, taxels)
        self._stuck = rng.permutation(taxels)[: given.stuck]
        self.live = np.ones(taxels, dtype=np.bool_)
        self.live[rng.permutation(taxels)[: round(given.dead_share * taxels)]] = False
        for module in rng.permutation(-(-taxels // MODULE))[: given.dead_modules]:
            self.live[module * MODULE : (module + 1) * MODULE] = False
        self._soft = SoftSkin(SKINS[given.skin], layout, gain, rng) if given.skin else None

    def read(self, h: Floats, t: float, elapsed: float, rng: np.random.Generator) -> Activation:
        """A scan of true activations h (M,) at t [s], after a share `elapsed` of the trial."""
        given = self._given
        floor: Floats | float = SILENT * given.sigma
        residue: Floats | float = 0.0
        if self._soft is None:
            z = self._gain * h + elapsed * self._offset + given.sigma * rng.standard_normal(len(h))
            felt = z >= floor
        else:
            z, felt = self._soft.read(h, t)
            floor, residue = self._soft.floor, self._soft.residue
        z = np.where(felt, np.minimum(z, 1.0), 0.0)
        z[self._stuck] = given.stuck_at
        return Activation(t, np.where(self.live, z, 0.0), self.live, floor, residue)


class SoftSkin:
    """A soft skin of the harness between true activations and readings.

    The harness presses a mesh against points of a cover. Here a trial's own activations are pressed
    in, so that thousands of trials are affordable: the cover sags from taxel to taxel. Figures,
    responses, foam and cross-talk are the harness's own (docs/physics.md). What its taxels have
    drawn lasts; what a press draws ends with it.
    """

    def __init__(
        self, config: MeshConfig, layout: Layout, gain: Floats, rng: np.random.Generator
    ) -> None:
        """`gain` (M,) of each taxel."""
        m = len(layout)
        self._gain, self._rng = gain, rng
        self._apart_m = np.linalg.norm(layout.position_m[:, None] - layout.position_m, axis=-1)
        self._sag_m = PerPress(config.sag_m, m, rng)
        self._response = Response(config, m, rng)
        self._foam = Foam(config, m, rng)
        self._cross_talk = CrossTalk(layout, config.cross_talk, rng)
        noise_counts = drawn(config.noise_counts, rng.standard_normal(m))
        self._noise = noise_counts / SkinConfig().full_scale_counts
        self._kept = Residue(m)
        self._is_pressed = False
        self.floor, self.residue = np.zeros((2, m))  # of the last scan

    def read(self, h: Floats, t: float) -> tuple[Floats, Bools]:
        """Activations z (M,), with noise, for true ones h (M,) at t [s]; and which (M,) a daemon's
        rule for what foam keeps takes for pressed."""
        was_pressed, self._is_pressed = self._is_pressed, bool(h.any())
        if was_pressed and not self._is_pressed:
            self._sag_m.draw()
            self._foam.end()
        sagging = (np.exp(-self._apart_m / self._sag_m.now[:, None]) * h).max(axis=1)
        reading = self._gain * self._foam.press(self._response(sagging), t)
        z = self._cross_talk.add(reading) + self._noise * self._rng.standard_normal(len(h))
        least = np.maximum(FLOOR, SOFT_SILENT * self._noise)
        self._kept.on_scan(z, least)
        self.floor, self.residue = np.minimum(least + self._kept.level, 1.0), self._kept.level
        return z, self._kept.pressed


def places(given: TrialConditions, start: Poses, touches: int, rng: np.random.Generator) -> Poses:
    """(touches, 3) poses of the object during each touch; it is pushed in between, from `start`
    (3,) on."""
    along, turned = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0])
    step = [
        given.pushed_m * np.cos(along),
        given.pushed_m * np.sin(along),
        turned * given.pushed_rad,
    ]
    return np.asarray(start + np.arange(touches)[:, None] * np.array(step))


def nudged(
    given: TrialConditions, model: ObservationModel, press: Poses, rng: np.random.Generator
) -> Poses:
    """How far (3,) a press (3,) moves the object and turns it about its centre, in its own frame:
    0.5 to 1.5 × `nudged_m`, along the contact's normal or up to `NUDGE_RAD` beside it."""
    size, aside, turn = rng.uniform([0.5, -1.0, -1.0], [1.5, 1.0, 1.0])
    ax, ay = contacts.axis_in_object(press[None])
    _, gx, gy = model.scene.clearance(ax, ay)
    angle = float(np.arctan2(-gy, -gx)[0]) + NUDGE_RAD * aside
    moved = given.nudged_m * size * np.array([np.cos(angle), np.sin(angle)])
    centre, turned = model.scene.centre, given.nudged_m / model.scene.mean_radius * turn
    about = se2.rotation_about(centre, turned)
    return np.array([*(about[:2] + moved), turned])


def reported(given: TrialConditions, sensor: Poses, error: Poses) -> Poses:
    """The sensor pose (3,) that the robot reports; `error` (3,) in standard deviations."""
    sd = np.array([given.sensor_sd_m, given.sensor_sd_m, given.sensor_sd_rad])
    return sensor + sd * error if sd.any() else sensor


def on_one_side(model: ObservationModel, rng: np.random.Generator) -> Accepts:
    """Accepts poses (N, 3) at which the skin is on one side of the object, which is drawn."""
    centre, side = model.scene.centre, float(rng.uniform(-np.pi, np.pi))

    def accepts(poses: Poses) -> Bools:
        """(N,) whether the skin is on that side of the object at `poses` (N, 3)."""
        ax, ay = contacts.axis_in_object(poses)
        angle = np.arctan2(ay - centre[1], ax - centre[0])
        return np.asarray(np.abs(se2.wrap(angle - side)) <= SIDE_RAD)

    return accepts


class Twin:
    """A second object of the same kind, close to the first."""

    def __init__(self, model: ObservationModel, rng: np.random.Generator) -> None:
        self._model = model
        direction, yaw = rng.uniform(-np.pi, np.pi, 2)
        self.pose = _beside(model, direction, yaw)  # (3,) in the first object's frame

    def activation(self, poses: Poses) -> Floats:
        """(N, M) of the twin alone, with the first object at `poses` (N, 3), sensor frame."""
        return self._model.activation(se2.compose(poses, self.pose))

    def is_clear(self, poses: Poses, depth_m: float) -> Bools:
        """(N,) whether the skin presses the twin no deeper than `depth_m`, with the first object at
        `poses` (N, 3), sensor frame."""
        seen = se2.compose(poses, self.pose)
        gap = contacts.clearance(self._model.scene, self._model.layout.radius_m, seen)
        return np.asarray(gap >= -depth_m)


def _beside(model: ObservationModel, direction: float, yaw: float) -> Poses:
    """The farthest pose (3,) in a direction, turned by `yaw`, at which an object is `TWIN_GAP_M`
    from the one at the origin."""
    scene = model.scene
    outline = se2.apply(np.array([0.0, 0.0, yaw]), scene.outline - scene.centre)
    along = np.array([np.cos(direction), np.sin(direction)])
    apart = np.arange(2.0 * scene.size + 2.0 * TWIN_GAP_M, 0.0, -TWIN_STEP_M)
    points = outline + scene.centre + apart[:, None, None] * along
    gap = scene.clearance(points[..., 0], points[..., 1])[0].min(axis=1)
    centre = scene.centre + apart[int((gap <= TWIN_GAP_M).argmax())] * along
    corner = centre - se2.apply(np.array([0.0, 0.0, yaw]), scene.centre[None])[0]
    return np.array([*corner, yaw])
