"""What a belief says in short: how sure it is, how far it may be off, and its status."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import UNMODELLED_M, Hypotheses, Status, Verdict, placed, status
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric

SPREAD = np.array([0.001, 0.001, 0.01])
SURE = Hypotheses()


def verdict(
    model: ObservationModel,
    apart_m: float = 0.1,
    share: float = 0.0,
    hypotheses: Hypotheses = SURE,
    here: float = 1.0,
    **keys: float,
) -> Verdict:
    """Of a narrow belief, a share of which is elsewhere."""
    poses = around(1000)
    poses[: round(1000 * share), 0] += apart_m
    belief = pf.equal(poses, np.empty((1000, 0)))
    config = FilterConfig(**keys)  # type: ignore[arg-type]
    return Verdict(placed(belief, PoseMetric(model.scene), config), here, hypotheses)


def around(n: int) -> Poses:
    return SPREAD * np.random.default_rng(0).standard_normal((n, 3)).clip(-2.0, 2.0)


@pytest.mark.parametrize(("share", "here"), [(0.0, 1.0), (0.25, 1.0), (0.4, 0.5)])
def test_p_is_the_weight_near_the_best_pose(
    box_model: ObservationModel, share: float, here: float
) -> None:
    p = verdict(box_model, share=share, here=here).p
    assert p == pytest.approx(here * (1.0 - share), abs=0.005)


def test_equivalent_poses_are_near_each_other(box_model: ObservationModel) -> None:
    assert box_model.scene.symmetry == 2
    poses = around(1000)
    poses[::2, 2] += np.pi
    config, metric = FilterConfig(), PoseMetric(box_model.scene)
    found = placed(pf.equal(poses, np.empty((1000, 0))), metric, config)
    assert found.within > 0.995
    assert found.radius_m < 0.01


def test_a_little_more_room_makes_a_belief_a_little_surer(
    box_model: ObservationModel,
) -> None:
    """Robot, foam and shape err as well, so no particle is within it or not."""
    found = [verdict(box_model, 0.01, 0.4, within_m=0.003 + 2e-4 * k).p for k in range(21)]
    assert (np.diff(found) > 0.0).all()
    assert np.diff(found).max() < 0.1
    assert found[-1] - found[0] > 0.4


def test_the_radius_holds_every_particle_and_grows_as_less_is_risked(
    box_model: ObservationModel,
) -> None:
    risks = (0.5, 0.1, 1e-3, 1e-6)
    for share in (0.0, 0.01):
        radii = [verdict(box_model, share=share, risk=risk).place.radius_m for risk in risks]
        assert (np.diff(radii) > 0.0).all()
        assert min(radii) > UNMODELLED_M
        assert min(radii) > 0.09 * (share > 0.0)


STANDS, MOVED, OTHER = (
    Hypotheses(*each) for each in ((0.6, 0.3, 0.1), (0.3, 0.5, 0.2), (0.2, 0.3, 0.5))
)


@pytest.mark.parametrize(
    ("hypotheses", "p", "expected"),
    [
        pytest.param(STANDS, 0.99, Status.CONVERGED, id="sure"),
        pytest.param(STANDS, 0.98, Status.AMBIGUOUS, id="not sure"),
        pytest.param(MOVED, 0.99, Status.CONVERGED, id="found where it was put"),
        pytest.param(MOVED, 0.98, Status.INCONSISTENT, id="put elsewhere"),
        pytest.param(OTHER, 0.2, Status.INCONSISTENT, id="something else"),
    ],
)
def test_status(
    box_model: ObservationModel, hypotheses: Hypotheses, p: float, expected: Status
) -> None:
    made = verdict(box_model, hypotheses=hypotheses)
    made = Verdict(replace(made.place, within=p), 1.0, hypotheses)
    assert status(made, 3) is expected
    assert status(made, 0) is Status.SEARCHING
    assert status(made, 3, blind=True) is Status.BLIND


def test_while_no_place_has_much_weight_it_searches(box_model: ObservationModel) -> None:
    poses = np.random.default_rng(0).uniform(-0.5, 0.5, (1000, 3))
    belief = pf.equal(poses, np.empty((1000, 0)))
    made = Verdict(placed(belief, PoseMetric(box_model.scene), FilterConfig()), 1.0, STANDS)
    assert status(made, 2) is Status.SEARCHING
