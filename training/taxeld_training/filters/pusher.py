"""An object that is touched while it stands, and then pushed along: a quasi-static world.

The object lies on a table (`ground`) and gives way when the skin presses deeper than its friction
resists. Friction and load differ from trial to trial, and from what a filter assumes.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.push import Push
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld_training.filters.conditions import Conditions, TrialSkin
from taxeld_training.filters.ground import Ground
from taxeld_training.filters.motion import SCAN_S
from taxeld_training.filters.trials import Moment, Trial

TOUCHES = 6  # before the push
PATH_M = 0.25  # way of the sensor in contact
STEP_M = 0.002  # between two scans
DEPTH_M = 0.003  # depth of the skin at which the object's friction gives way
OFF_CENTRE = 0.3  # largest distance of the push from the centre, as a share of the mean radius
STANDOFF_M = 0.06
BETWEEN_S = 1.0  # the last touch and the push
SETTLING = 4  # steps of projection that end the overlap
TOLD_SPREAD = 0.2  # sd of a push that is told, as a share of it: what the ground leaves open
CLOSE_M = 1e-9  # less is no overlap


@dataclass(frozen=True)
class PushedTrial:
    """`TOUCHES` presses of the object, then a push along a straight line."""

    model: ObservationModel
    seed: int

    @property
    def ground(self) -> Ground:
        """That of this trial."""
        return Ground.drawn(self.model.scene, np.random.default_rng((self.seed, 3)))

    def __iter__(self) -> Iterator[Moment]:
        model, rng = self.model, np.random.default_rng((self.seed, 2))
        for scan in Trial(model, self.seed, TOUCHES):
            yield scan
        truth, t = scan.truth, scan.activation.t + BETWEEN_S
        given = Conditions()
        skin = TrialSkin(given, model.layout, given.gains(len(model.layout), rng), rng)
        radius_m = model.scene.mean_radius
        ground = self.ground
        heading, yaw = rng.uniform(-np.pi, np.pi, 2)
        ahead = np.array([np.cos(heading), np.sin(heading)])
        aside = np.array([-ahead[1], ahead[0]]) * rng.uniform(-OFF_CENTRE, OFF_CENTRE) * radius_m
        centre = se2.compose(truth, np.array([*model.scene.centre, 0.0]))[:2]
        at = centre + aside - (model.scene.size + model.layout.radius_m + STANDOFF_M) * ahead
        path_m, way_m = 0.0, 0.0
        while path_m < PATH_M and way_m < 2.0 * PATH_M + 4.0 * model.scene.size:
            before = np.array([*at, yaw])
            at = at + STEP_M * ahead
            way_m += STEP_M
            sensor = np.array([*at, yaw])
            truth = gave_way(model, ground, truth[None], before, sensor)[0][0]
            h = model.activation(se2.compose(se2.inverse(sensor), truth)[None])[0]
            path_m += STEP_M if h.any() else 0.0
            activation = skin.read(h, t, 0.0, rng)
            yield Moment(TOUCHES, activation, sensor, truth)
            t += SCAN_S


def gave_way(
    model: ObservationModel, ground: Ground, poses: Poses, before: Poses, after: Poses,
    depth_m: float = DEPTH_M, *, limited: bool = False,
) -> tuple[Poses, Floats]:  # fmt: skip
    """The object's poses (N, 3) once the sensor has moved from one pose (3,) to another and presses
    `depth_m` deep, and how far each was pushed (N,): with `limited` no farther than the sensor
    went, so that a pose that overlaps the skin from the start is not thrown out of it."""
    pushed, limit = np.zeros(len(poses)), np.full(len(poses), np.inf)
    moved = np.tile(after[:2] - before[:2], (len(poses), 1))
    for _ in range(SETTLING):
        ax, ay = contacts.axis_in_object(se2.compose(se2.inverse(after), poses))
        clearance, gx, gy = model.scene.clearance(ax, ay)
        inwards = -np.column_stack([gx, gy])
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        seen = np.column_stack(
            [c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0]]
        )
        along = np.sum(seen * inwards, axis=1)
        if limited and moved.any():
            limit = np.maximum(along, 0.0)
        gives = np.clip(model.layout.radius_m - clearance - depth_m, 0.0, limit - pushed)
        some = gives > CLOSE_M
        if not some.any():
            break
        pushed += gives
        wanted = gives[:, None] * inwards + seen - along[:, None] * inwards
        contact = np.column_stack([ax, ay]) + clearance[:, None] * inwards
        slide = np.zeros((len(poses), 3))
        slide[some] = ground.slide(contact[some], wanted[some], inwards[some])
        poses = se2.compose(poses, slide)
        moved = np.zeros_like(moved)
    return poses, pushed


def told(ground: Ground) -> Push:
    """As `estimator.push.push`, but by the world's own ground: the limit of what can be known of a
    push, as no filter knows what the object rests on."""

    def push(
        model: ObservationModel, metric: PoseMetric, poses: Poses, assumed: Floats, before: Poses,
        after: Poses, depth_m: float, rng: np.random.Generator,
    ) -> tuple[Poses, Floats]:  # fmt: skip
        del assumed
        poses, pushed = gave_way(model, ground, poses, before, after, depth_m, limited=True)
        noise = TOLD_SPREAD * pushed[:, None] * rng.standard_normal((len(poses), 3))
        centre = metric.centres(poses) + noise[:, :2]
        return metric.placed(centre, poses[:, 2] + noise[:, 2] / model.scene.mean_radius), pushed

    return push


def travel(start: Poses, end: Poses) -> tuple[float, float]:
    """Distance [m] and turn [rad] from one pose (3,) to another."""
    gap = se2.compose(se2.inverse(start), end)
    return float(np.hypot(gap[0], gap[1])), float(abs(gap[2]))
