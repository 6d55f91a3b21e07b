"""Priors: what is none, what they do to a belief, and how touches refute them."""

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import SURE, Status
from taxeld.estimator.priors import FLOOR, BeliefPrior, PriorDensity
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld.prior import PosePrior, read_prior
from tests.rig.pressed_box import TRUTH, World, estimator, settled

SD = [0.02, 0.02, 0.1]
GOOD = {"x": 0.1, "y": 0.05, "theta": 0.3, "cov": SD}
SIDES = (3.6, 5.2, 0.7)


def prior(**keys: object) -> PosePrior:
    made = read_prior(GOOD | keys)
    assert isinstance(made, PosePrior), made
    return made


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"x": None}, "x: is required"),
        ({"y": 400.0}, "y: must be -10..10 m, not 400"),
        ({"theta": 90.0}, "theta: must be -9.5..9.5 rad, not 90"),
        ({"cov": [0.02, 0.02]}, "cov: must be a list of 3"),
        ({"cov": [[1e-4, 0, 0], [0, 1e-4, 0], [0, 0]]}, "cov[2]: must be a list of 3, not [0, 0]"),
        ({"cov": [[1e-4, 1e-3, 0], [1e-3, 1e-4, 0], [0, 0, 1e-2]]}, "cov: is not symmetric and"),
        ({"cov": [[1e-4, 5e-5, 0], [0, 1e-4, 0], [0, 0, 1e-2]]}, "cov: is not symmetric and"),
        ({"cov": [-0.02, 0.02, 0.1]}, "cov[0]: must be a list of 3, not -0.02; give 3 standard"),
        ({"cov": [1e-9, 0.02, 0.1]}, "cov: standard deviations: from"),
        ({"weight": 1.0}, "weight: must be 0.01..0.95, not 1"),
        ({"object": "a" * 100}, "object: has more than 64 characters"),
        ({"zeta": 1.0}, "zeta: unknown key; did you mean theta"),
    ],
)
def test_what_is_none_is_said_in_a_line(keys: dict[str, object], says: str) -> None:
    found = read_prior(GOOD | keys)
    assert isinstance(found, str)
    assert found.startswith(says)
    assert "\n" not in found


@pytest.mark.parametrize("theta", [0.3, None])
def test_its_density_over_the_table_is_one_on_average(
    box_model: ObservationModel, theta: float | None
) -> None:
    metric = PoseMetric(box_model.scene)
    made = PriorDensity(prior(theta=theta), metric, FilterConfig(half_width_m=0.5), 0.0, 1)
    rng = np.random.default_rng(0)
    poses = rng.uniform([-0.5, -0.5, -np.pi], [0.5, 0.5, np.pi], (400_000, 3))
    assert np.exp(made.log_density(poses)).mean() == pytest.approx(1.0, abs=0.1)


def test_alone_it_is_believed_and_never_sure(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    subject.take_prior(prior(cov=[0.001, 0.001, 0.01], weight=0.95))
    found = subject.estimate
    assert found.status is Status.SEARCHING
    assert 0.8 < found.p < SURE
    assert np.allclose(found.map[:2], TRUTH[:2], atol=0.005)


def test_a_newer_one_takes_the_place_of_the_one_before(box_model: ObservationModel) -> None:
    """However often it is given, it counts once."""
    found = []
    for times in (1, 20):
        _, subject = settled(box_model)
        for _ in range(times):
            subject.take_prior(prior(x=0.15, weight=0.5))
        found.append(subject.estimate)
    once, often = found
    assert subject.belief.metric.distance(once.map, often.map) < 0.01
    assert once.p == pytest.approx(often.p, abs=0.05)


@pytest.mark.parametrize("after", [0, 3])
def test_touches_refute_a_wrong_one(box_model: ObservationModel, after: int) -> None:
    world = World(box_model)
    subject = world.knowing()
    for side in SIDES[:after]:
        world.press(subject, side)
    subject.take_prior(prior(x=0.3))
    found = world.find(subject)
    assert subject.belief.metric.distance(found.map, TRUTH) < 0.005
    subject.take_prior(prior(x=0.3))  # one that is elsewhere does not move a sure belief
    found = subject.estimate
    assert found.hypotheses.stands > 0.9
    assert subject.belief.metric.distance(found.map, TRUTH) < 0.005


SPREAD = np.array([0.003, 0.001, 0.05])


def test_an_earlier_belief_is_the_gaussians_of_its_modes(box_model: ObservationModel) -> None:
    """Each stands, equivalent poses are alike, and what it says against a pose is bounded."""
    rng, metric = np.random.default_rng(0), PoseMetric(box_model.scene)
    poses = rng.standard_normal((4000, 3)) * SPREAD
    poses[2000:, 0] += 0.3
    weight = np.full(len(poses), 1.0 / len(poses))
    made = BeliefPrior(metric, poses, weight, metric.modes(poses, weight, 0.05, 5, 64))
    at = np.array(
        [[0, 0, 0], [0.003, 0, 0], [0, 0.002, 0], [0, 0, 0.1], [0.3, 0, 0], [0, 0, np.pi]]
    )
    lost = made.log_density(at)[0] - made.log_density(at)
    assert np.allclose(lost, [0.0, 0.5, 1.6, 2.0, 0.0, 0.0], atol=0.3)
    between, far = made.ceiling - made.log_density(np.array([[0.15, 0, 0], [9.0, 9.0, 1.0]]))
    assert between > 10.0
    assert far == pytest.approx(-np.log(FLOOR), abs=1e-6)
