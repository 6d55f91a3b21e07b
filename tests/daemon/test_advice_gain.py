"""Advised touches tell more than others: of a round body of which only a handle tells how it is
turned, the handle is to be met, by a link whose skin feels it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from taxeld.advice import hypotheses, lines
from taxeld.advice.advice import Advisor, Approach
from taxeld.advice.hypotheses import Guesses
from taxeld.advice.lines import Lines, Reach
from taxeld.advice.outcomes import MISS_M, Outcomes
from taxeld.arrays import Bools, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.estimator import Estimator
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from tests.rig.pressed_box import TRUTH, World

from .test_advice import asked, follow, handled

TURNED = se2.compose(TRUTH, np.array([0.0, 0.0, np.pi]))  # the handle is on the other side
OTHERS = 8  # approaches that were not advised


class NoSamples:
    """A proposal without samples: all that is learned is what a belief made by hand is left."""

    name = "table"

    def propose(self, z: np.ndarray, live: np.ndarray, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        return np.empty((0, 3))


def torn(model: ObservationModel) -> Estimator:
    """A belief in TRUTH and TURNED alike, and in little beside them."""
    subject = Estimator(
        model, NoSamples(), FilterConfig(), beside=[NoSamples()] * (len(model.links) - 1)
    )
    rule, n = subject.rule, subject.config.particles
    off = np.random.default_rng(0).standard_normal((n, 3)) * (0.001, 0.001, 0.01)
    pose = off + np.where((np.arange(n) % 2 == 0)[:, None], TRUTH, TURNED)
    rule.belief = pf.equal(pose, rule.memory.explain(pose))
    return subject


@pytest.fixture(autouse=True)
def both(monkeypatch: pytest.MonkeyPatch) -> Guesses:
    """What advice takes for possible: both, a little spread."""
    off = np.random.default_rng(1).standard_normal((20, 3)) * (0.001, 0.001, 0.01)
    pose = off + np.repeat([TRUTH, TURNED], 10, axis=0)
    made = Guesses(pose, np.zeros(20, np.intp), np.full(20, 0.05), 0)

    def drawn(*_: object) -> Guesses:
        return made

    monkeypatch.setattr(hypotheses, "drawn", drawn)
    return made


def all_of(subject: Estimator, found: Guesses) -> Iterator[tuple[Lines, float, Approach]]:
    """Every approach that advice chooses from, and the probability that it leaves one pose."""
    advisor, outcomes = Advisor(subject, Reach()), Outcomes(subject, found)
    free, ways = advisor.free(advisor.fan(found, 0), found)
    for c in range(len(free)):
        line = free.only(slice(c, c + 1))
        told = outcomes.by_reading(line, ways[c], 0.003)
        yield line, told.sure, advisor._approach(line, ways[c], found, told, 0.0)


def share_right(model: ObservationModel, approach: Approach) -> float:
    """The belief in TRUTH after an approach."""
    subject, world = torn(model), World(model)
    follow(world, subject, approach)
    rule = subject.rule
    return float(rule.belief.weight[rule.metric.distance(rule.belief.pose, TRUTH) < 0.01].sum())


def test_an_advised_touch_tells_apart_what_most_others_leave_open(
    skin: Layout, both: Guesses
) -> None:
    model = handled(skin)
    subject = torn(model)
    best = asked(subject, Reach()).approaches[0]
    every = list(all_of(subject, both))
    usual = float(np.mean([sure for _, sure, _ in every]))
    assert best.p_sure > 0.95
    assert best.p_sure > usual + 0.3
    rng = np.random.default_rng(2)
    others = [every[c][2] for c in rng.choice(len(every), OTHERS, replace=False).tolist()]
    left = float(np.mean([share_right(model, one) for one in others]))
    advised = share_right(model, best)
    assert advised > 0.9
    assert advised > left + 0.15


def test_a_link_whose_skin_faces_away_is_not_advised_though_it_would_come_first(
    skin: Layout,
) -> None:
    """Neither link may turn, and the handle is met from one side alone: by the back of the first
    link, which feels nothing there, and by the second one's skin."""

    def only(of: Bools) -> Layout:
        return replace(
            skin, uid=skin.uid[of], position_m=skin.position_m[of], normal=skin.normal[of]
        )

    right = skin.normal[:, 0] > 0.3
    ahead = (float(np.degrees(TRUTH[2])) + 180.0,)  # onto the handle, from outside
    config = Reach(directions_deg=ahead, yaw_deg=(0.0, 0.0))
    for layouts, feels in (((right, ~right), 1), ((~right, right), 0)):
        first, second = map(only, layouts)
        model = handled(first, second)
        best, *_ = asked(torn(model), config).approaches
        assert best.link == feels
        assert best.p_sure > 0.95
        alone = handled((first, second)[1 - feels])
        assert asked(torn(alone), config).approaches[0].p_sure < 0.5


def test_a_press_that_no_live_taxel_feels_tells_nothing(skin: Layout, both: Guesses) -> None:
    subject = torn(handled(skin))
    line, _, _ = max(all_of(subject, both), key=lambda each: each[1])
    outcomes = Outcomes(subject, both)
    way = lines.travel(line, subject.model, both.pose)[0]
    outcomes._like = [
        replace(outcomes._like[0], live=np.zeros(len(skin), np.bool_)),
    ]
    told = outcomes.by_reading(line, way, 0.003)
    assert told.sure == 0.0
    assert told.cost_m == pytest.approx(outcomes.now_m + MISS_M)
