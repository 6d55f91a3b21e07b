"""Where a pushed object goes, and that the belief goes with it."""

import numpy as np
import pytest

from taxeld.arrays import Floats, Poses
from taxeld.estimator import particles as pf
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.push import assumed, changed, push
from taxeld.model.symmetry import PoseMetric

DEPTH_M = 0.003
N = 4000


def beside(model: ObservationModel, y: float, depth_m: float) -> Poses:
    """A sensor pressed so deep into the box's face at +x, at a height y of it."""
    x = np.linspace(0.2, 0.0, 20_001)
    at = np.column_stack([x, np.full_like(x, y), np.zeros_like(x)])
    gap = contacts.clearance(model.scene, model.layout.radius_m, se2.inverse(at))
    return np.asarray(at[np.argmax(gap <= -depth_m)])


def pushed(
    model: ObservationModel, before: Poses, after: Poses, ground: list[float] | None = None
) -> tuple[Poses, Floats]:
    """The box at the origin, N times, on as many grounds or on the one that is given."""
    rng = np.random.default_rng(0)
    grounds = assumed(N, rng) if ground is None else np.tile(ground, (N, 1))
    metric = PoseMetric(model.scene)
    return push(model, metric, np.zeros((N, 3)), grounds, before, after, DEPTH_M, rng)


def test_a_push_through_the_middle_moves_it_straight(box_model: ObservationModel) -> None:
    before, after = beside(box_model, 0.0, DEPTH_M), beside(box_model, 0.0, DEPTH_M + 0.004)
    poses, far = pushed(box_model, before, after)
    assert np.allclose(far, 0.004, atol=3e-4)
    assert np.allclose(poses.mean(axis=0), [-0.004, 0.0, 0.0], atol=[3e-4, 3e-4, 5e-3])


def test_a_push_beside_the_middle_turns_it_and_the_contact_goes_as_far_as_it_was_pushed(
    box_model: ObservationModel,
) -> None:
    """At +y, towards −x: counter-clockwise. The sensor is as deep as was felt, on average."""
    before, after = beside(box_model, 0.03, DEPTH_M), beside(box_model, 0.03, DEPTH_M + 0.002)
    poses, _ = pushed(box_model, before, after)
    assert poses[:, 2].mean() > 0.01
    assert poses[:, 0].mean() > -0.002
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


@pytest.mark.parametrize("side", [-1.5, 1.5])
def test_a_push_past_the_centre_of_friction_turns_the_box_about_it(
    box_model: ObservationModel, side: float
) -> None:
    """The sensor comes from +x, through the middle."""
    before, after = beside(box_model, 0.0, DEPTH_M), beside(box_model, 0.0, DEPTH_M + 0.004)
    poses, _ = pushed(box_model, before, after, [0.0, side, 0.0, 0.0])
    assert poses[:, 2].mean() * side < -0.01


def test_a_contact_slips_off_a_smooth_object_and_takes_a_rough_one_along(
    box_model: ObservationModel,
) -> None:
    before = beside(box_model, 0.0, DEPTH_M)
    after = before + np.array([-0.002, 0.002, 0.0])
    smooth, rough = (
        pushed(box_model, before, after, [0.0, 0.0, 0.0, mu])[0].mean(axis=0) for mu in (-9.0, 3.0)
    )
    assert smooth[:2] == pytest.approx([-0.002, 0.0], abs=3e-4)
    assert rough[1] > 8e-4


def test_those_particles_stay_whose_ground_explains_where_the_object_went(
    box_model: ObservationModel,
) -> None:
    """It is pushed through its middle, and turns: its load lies to the side."""
    rng, metric = np.random.default_rng(1), PoseMetric(box_model.scene)
    truth, n = np.zeros(3), 800
    belief = pf.equal(np.zeros((n, 3)), ground=assumed(n, rng))
    for _ in range(12):
        before = se2.compose(truth, beside(box_model, 0.0, DEPTH_M))
        after = se2.compose(truth, beside(box_model, 0.0, DEPTH_M + 0.002))
        same = np.tile(truth, (N, 1)), np.tile([0.0, 1.5, 0.0, 0.0], (N, 1))
        went = push(box_model, metric, *same, before, after, DEPTH_M, rng)[0].mean(axis=0)
        args = box_model, metric, belief.pose, belief.ground, before, after, DEPTH_M, rng
        belief.pose, _ = push(*args)
        off = (belief.pose - went) / [2e-4, 2e-4, 5e-3]
        pf.reweight(belief, -0.5 * np.sum(off**2, axis=1))
        belief = pf.resample(belief, n, rng)
        belief.ground = changed(belief.ground, 0.2, rng)
        truth = went
    assert belief.ground[:, 1].mean() > 0.8
    assert abs(truth[2]) > 0.05
