"""Where a pushed object goes, and that the belief goes with it."""

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.estimator.push import push
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric

DEPTH_M = 0.003
N = 4000


def pushed(
    model: ObservationModel, before: Poses, after: Poses, felt_m: float = DEPTH_M
) -> tuple[Poses, np.ndarray]:
    """The box at the origin, N times."""
    rng = np.random.default_rng(0)
    return push(model, PoseMetric(model.scene), np.zeros((N, 3)), before, after, felt_m, rng)


def beside(model: ObservationModel, y: float, depth_m: float) -> Poses:
    """A sensor pressed so deep into the box's face at +x, at a height y of it."""
    x = np.linspace(0.2, 0.0, 20_001)
    at = np.column_stack([x, np.full_like(x, y), np.zeros_like(x)])
    gap = contacts.clearance(model.scene, model.layout.radius_m, se2.inverse(at))
    return np.asarray(at[np.argmax(gap <= -depth_m)])


def test_a_push_through_the_middle_moves_it_straight(box_model: ObservationModel) -> None:
    before, after = beside(box_model, 0.0, DEPTH_M), beside(box_model, 0.0, DEPTH_M + 0.004)
    poses, far = pushed(box_model, before, after)
    assert np.allclose(far, 0.004, atol=3e-4)
    assert np.allclose(poses.mean(axis=0), [-0.004, 0.0, 0.0], atol=[3e-4, 3e-4, 5e-3])


def test_a_push_beside_the_middle_turns_it(box_model: ObservationModel) -> None:
    """At +y, towards −x: counter-clockwise."""
    before, after = beside(box_model, 0.03, DEPTH_M), beside(box_model, 0.03, DEPTH_M + 0.004)
    poses, _ = pushed(box_model, before, after)
    assert poses[:, 2].mean() > 0.02
    assert poses[:, 0].mean() > -0.004


def test_the_contact_goes_as_far_as_it_was_pushed(box_model: ObservationModel) -> None:
    """Whatever the turn, the sensor is in the end as deep as was felt, on average."""
    before, after = beside(box_model, 0.03, DEPTH_M), beside(box_model, 0.03, DEPTH_M + 0.002)
    poses, _ = pushed(box_model, before, after)
    seen = se2.compose(se2.inverse(after), poses)
    depth = -contacts.clearance(box_model.scene, box_model.layout.radius_m, seen)
    assert np.isclose(depth.mean(), DEPTH_M, atol=4e-4)


@pytest.mark.parametrize(
    ("first", "last"),
    [
        pytest.param(0.001, DEPTH_M, id="it only pressed deeper, as was felt"),
        pytest.param(DEPTH_M + 0.004, DEPTH_M, id="it withdrew"),
        pytest.param(-0.05, -0.04, id="it does not touch"),
    ],
)
def test_what_is_not_pushed_stays(box_model: ObservationModel, first: float, last: float) -> None:
    poses, far = pushed(box_model, beside(box_model, 0.0, first), beside(box_model, 0.0, last))
    assert far.max() < 1e-4
    assert np.allclose(poses, 0.0, atol=1e-3)


def test_it_is_never_pushed_farther_than_the_sensor_went(box_model: ObservationModel) -> None:
    """A particle that was far inside does not leap out."""
    _, far = pushed(box_model, beside(box_model, 0.0, 0.010), beside(box_model, 0.0, 0.012))
    assert far.max() <= 0.0021
