"""Half the samples are drawn where touches take longer than they have; the warm-up."""

from dataclasses import dataclass

import numpy as np
import pytest

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.pipeline.warm_up import warm_up
from taxeld.proposals import bundle, several
from taxeld.proposals.samples import PATIENCE, Samples
from tests.rig.configurations import config

SKIN = layouts.load("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")


@dataclass
class Asked:
    """A proposal that gives as many samples as are wanted."""

    name: str

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        return np.zeros((n, 3))


@pytest.fixture
def samples() -> Samples:
    return Samples([Asked("density"), Asked("table")])


def drawn(samples: Samples) -> list[int]:
    """How many samples of each object are drawn where 40 are wanted."""
    z, live, rng = np.zeros(5), np.ones(5, dtype=bool), np.random.default_rng(0)
    return [len(samples.of(k).propose(z, live, 40, rng)) for k in range(2)]


def test_after_several_late_touches_half_the_samples_of_each_object_are_drawn_until_a_reset(
    samples: Samples,
) -> None:
    assert [samples.took(11.0, 10.0) for _ in range(PATIENCE)] == [False] * (PATIENCE - 1) + [True]
    assert drawn(samples) == [20, 20]
    assert not any(samples.took(11.0, 10.0) for _ in range(2 * PATIENCE)), "it is said once"
    assert drawn(samples) == [20, 20]
    samples.begin_anew()
    assert drawn(samples) == [40, 40]


def test_now_and_then_a_touch_may_take_longer(samples: Samples) -> None:
    for _ in range(10):
        assert not any(samples.took(11.0, 10.0) for _ in range(PATIENCE - 1))
        assert not samples.took(9.0, 10.0)
    assert drawn(samples) == [40, 40]


def test_a_warm_up_leaves_no_trace_in_the_belief() -> None:
    box, found = bundle.load("box", SKIN, 0.005), []
    for warm in (False, True):
        samples = several.untimed([box], FilterConfig())
        subject = Estimator(box.model, samples.of(0), FilterConfig())
        if warm:
            warm_up(config(), [box.model], samples)
        found.append(subject.rule.belief.pose.tobytes())
    assert found[0] == found[1]
