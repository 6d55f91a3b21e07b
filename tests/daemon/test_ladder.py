"""Samples are saved where touches take longer than they have, one rung of the ladder at a time."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, count, repeat

import numpy as np
import pytest

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.pipeline.warm_up import warm_up
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.ladder import PATIENCE, Ladder, Rung, Step
from tests.rig.configurations import config

SKIN = layouts.load("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")
RNG = np.random.default_rng(0)


@dataclass
class Asked:
    """A proposal that notes how many samples are wanted."""

    name: str
    asked: list[int] = field(default_factory=list)

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        self.asked.append(n)
        return np.zeros((n, 3))


@pytest.fixture
def ladder() -> Ladder:
    return Ladder(
        [
            Rung(Step.CHOSEN, Asked("ddpm")),
            Rung(Step.CHEAPER, Asked("density")),
            Rung(Step.FEWER, Asked("density"), 0.25),
            Rung(Step.TABLE, Asked("table")),
        ]
    )


@pytest.fixture(scope="module")
def box() -> Bundle:
    return bundle.load("box", SKIN, 0.005)


def served(ladder: Ladder) -> tuple[str, int, Step]:
    """The proposal of a call for 40 samples, how many it is asked for, and the step in messages."""
    z, live = np.zeros(5), np.ones(5, dtype=bool)
    return ladder.name, len(ladder.propose(z, live, 40, RNG)), ladder.rung.step


def test_touches_that_repeatedly_do_not_fit_take_it_down_by_one_rung(ladder: Ladder) -> None:
    found = []
    for _ in range(4):
        found.append(served(ladder))
        stepped = [ladder.took(11.0, 10.0) for _ in range(PATIENCE)]
        assert stepped == [False] * (PATIENCE - 1) + [found[-1][2] is not Step.TABLE]
    assert found == [
        ("ddpm", 40, Step.CHOSEN),
        ("density", 40, Step.CHEAPER),
        ("density", 10, Step.FEWER),
        ("table", 40, Step.TABLE),
    ]
    assert served(ladder) == found[-1], "the last rung serves whatever it takes"


def test_now_and_then_a_touch_may_take_longer(ladder: Ladder) -> None:
    for _ in range(10):
        assert not any(ladder.took(11.0, 10.0) for _ in range(PATIENCE - 1))
        assert not ladder.took(9.0, 10.0)
    assert served(ladder)[2] is Step.CHOSEN


def test_a_reset_goes_back_to_what_fitted_at_start(ladder: Ladder) -> None:
    ladder.first = 1
    ladder.step_down()
    ladder.step_down()
    ladder.begin_anew()
    assert served(ladder)[2] is Step.CHEAPER


@pytest.mark.parametrize(
    ("ms", "step"), [((9,), Step.CHOSEN), ((11,), Step.TABLE), ((11, 11, 9), Step.FEWER)]
)
def test_a_rung_on_which_touches_do_not_fit_is_passed_over_at_start(
    box: Bundle, ladder: Ladder, ms: tuple[int, ...], step: Step
) -> None:
    """`ms`: what each scan takes on each rung, and on the last of them from there on."""
    ladder.rungs = [Rung(rung.step, box.proposal("manifold"), rung.share) for rung in ladder.rungs]

    def clock() -> Iterator[int]:
        ns = 0
        for each in chain(ms, repeat(ms[-1])):
            for _ in range(5 * 4):  # touches, and scans of each
                yield ns
                ns += each
                yield ns

    warm_up(config(), [box.model], ladder, clock().__next__, 10.0)
    assert ladder.rung.step is step


def test_a_warm_up_leaves_no_trace_in_the_belief(box: Bundle) -> None:
    found = []
    for warm in (False, True):
        ladder = box.untimed(FilterConfig())
        subject = Estimator(box.model, ladder, FilterConfig())
        if warm:
            warm_up(config(), [box.model], ladder, count().__next__, 1e9)
        found.append(subject.rule.belief.pose.tobytes())
    assert found[0] == found[1]


def test_below_the_chosen_sampler_are_cheaper_ones_and_fewer_samples(box: Bundle) -> None:
    opened = choice.open_all(box, FilterConfig(proposal="ddpm-100"))
    steps = [rung.step for rung in choice.rungs(box, opened, "ddpm-100", 50)]
    assert steps == sorted(steps)
    assert steps[0] is Step.CHOSEN
    assert {Step.CHEAPER, Step.FEWER} < set(steps)
