"""A box that is pressed, and an estimator that feels it."""

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.model import contacts, se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.proposals.analytic import Projection

TRUTH = np.array([0.1, 0.05, 0.3])


def estimator(model: ObservationModel, **keys: int | str) -> Estimator:
    return Estimator(model, Projection(model), FilterConfig(**keys))  # type: ignore[arg-type]


def feel(model: ObservationModel, sensor: np.ndarray, t: float) -> Activation:
    seen = se2.compose(se2.inverse(sensor), TRUTH)
    z = model.activation(seen[None])[0]
    return Activation(t, np.where(z > 0.02, z, 0.0), np.ones(len(z), dtype=bool))


def press(gap_m: float) -> np.ndarray:
    """A sensor pose that far from the box's long face, on its x axis."""
    return se2.compose(TRUTH, np.array([0.03 + 0.04 + gap_m, 0.01, 0.0]))


def approach(subject: Estimator, model: ObservationModel, t: float = 0.0) -> Estimate:
    """A press of 4 mm in steps of 1 mm; → the estimate when it is held."""
    for gap in (0.02, 0.01, 0.002, -0.001, -0.002, -0.003, -0.004, -0.004):
        subject.on_scan(feel(model, press(gap), t), press(gap))
        t += 0.05
    return subject.estimate


class Knowing:
    """A proposal that knows the truth to a few millimetres: what is tested is what follows."""

    name = "table"

    def __init__(self, world: "World") -> None:
        self._world = world

    def propose(self, z: np.ndarray, live: np.ndarray, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        seen = se2.compose(se2.inverse(self._world.sensor), self._world.truth)
        return np.asarray(seen + rng.standard_normal((n, 3)) * (0.003, 0.003, 0.05))


class World:
    """An object, and presses of it from all sides."""

    def __init__(self, model: ObservationModel) -> None:
        self.model, self.truth, self.sensor, self.t = model, TRUTH, np.zeros(3), 0.0
        self.gain: Floats | float = 1.0  # of the taxels

    def knowing(self, **keys: int) -> Estimator:
        """An estimator whose samples are near the truth."""
        return Estimator(self.model, Knowing(self), FilterConfig(**keys))  # type: ignore[arg-type]

    def press(
        self, subject: Estimator, angle: float, depth_m: float = 0.003, link: int = 0
    ) -> Estimate:
        """Come near at an angle about the object, press, hold, let go; → the held estimate."""
        model = self.model.links[link]
        seen, away = (box_side(model, angle, depth) for depth in (depth_m, -0.02))
        for at in (away, seen, seen, seen):
            held = self.feel(subject, at, link)
        self.feel(subject, away, link)
        self.t += 1.0
        self.feel(subject, away, link)
        return held

    def find(self, subject: Estimator, least: int = 1, most: int = 24) -> Estimate:
        """Press from further and further sides until the estimate is sure."""
        for k in range(most):
            estimate = self.press(subject, 0.2 + 1.35 * k)
            if k + 1 >= least and estimate.status is Status.CONVERGED:
                return estimate
        raise AssertionError(f"{estimate.status!r} with p = {estimate.p} after {most} touches")

    def feel(self, subject: Estimator, at: Poses, link: int = 0) -> Estimate:
        self.sensor = se2.compose(self.truth, at)
        felt = self.model.links[link].activation(se2.inverse(at)[None])[0]
        z = np.minimum(self.gain * felt, 1.0)
        self.t += 0.05
        activation = Activation(self.t, z, np.ones(len(z), dtype=bool))
        return subject.on_scan(activation, self.sensor, link)


def box_side(model: ObservationModel, angle: float, depth_m: float) -> Poses:
    """The sensor's pose in the object's frame as it comes from an angle, so deep."""
    far = np.linspace(0.3, 0.0, 3001)
    at = np.column_stack([far * np.cos(angle), far * np.sin(angle), np.full(3001, angle)])
    gap = contacts.clearance(model.scene, model.layout.radius_m, se2.inverse(at))
    return np.asarray(at[np.argmax(gap < -depth_m)])


def settled(model: ObservationModel) -> tuple[World, Estimator]:
    world = World(model)
    subject = world.knowing()
    estimate = world.find(subject, least=4)
    assert subject.belief.metric.distance(estimate.map, TRUTH) < 0.003
    return world, subject
