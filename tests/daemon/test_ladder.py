"""The ladder of proposals, on a fake clock."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np
import pytest

from taxeld.arrays import Bools, Floats, Poses
from taxeld.proposals.ladder import OVERHEAD, PATIENCE, Cost, Ladder, Rung, Step

MS = 1_000_000
S = 40
RNG = np.random.default_rng(0)


@dataclass
class Clock:
    ns: int = 0

    def __call__(self) -> int:
        return self.ns


@dataclass
class Slow:
    """A proposal that takes a time of its own."""

    name: str
    clock: Clock
    ms: Callable[[], float]
    asked: list[int] = field(default_factory=list)

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        self.asked.append(n)
        self.clock.ns += round(self.ms() * MS)
        return np.zeros((n, 3))


@dataclass
class Bench:
    """A ladder of four proposals, of 8, 4, 2 (a quarter) and 1 ms, and a clock to set."""

    filter_ms: float = 0.0
    slower: float = 1.0

    def __post_init__(self) -> None:
        self.clock = Clock()
        self.ladder = Ladder(
            [
                self.rung(Step.CHOSEN, "ddpm", 8.0),
                self.rung(Step.CHEAPER, "density", 4.0),
                self.rung(Step.FEWER, "density", 2.0, 0.25),
                self.rung(Step.TABLE, "table", 1.0),
                Rung(Step.NONE),
            ],
            self.clock,
        )
        self.ladder.settle()

    def rung(self, step: Step, name: str, ms: float, share: float = 1.0) -> Rung:
        proposal = Slow(name, self.clock, lambda: self.slower * ms)
        return Rung(step, proposal, share, Cost(ms * MS))

    def call(self, left_ms: float) -> int:
        """Propose with so much time left, and use it; → how many samples came."""
        self.ladder.deadline_ns = self.clock.ns + left_ms * MS
        made = len(self.ladder.propose(np.zeros(1), np.ones(1, bool), S, RNG))
        self.clock.ns += round(self.slower * self.filter_ms * MS * bool(made))
        self.ladder.used()
        return made


@pytest.mark.parametrize(
    ("left_ms", "step", "samples"),
    [
        (float("inf"), Step.CHOSEN, S), (10.0, Step.CHOSEN, S), (9.9, Step.CHEAPER, S),
        (5.0, Step.CHEAPER, S), (4.9, Step.FEWER, S // 4), (2.4, Step.TABLE, S),
        (1.2, Step.NONE, 0), (-3.0, Step.NONE, 0),
    ],
)  # fmt: skip
def test_the_first_rung_that_the_time_left_carries_is_taken(
    left_ms: float, step: Step, samples: int
) -> None:
    bench = Bench()
    assert bench.call(left_ms) == samples
    assert bench.ladder.step is step
    assert asdict(bench.ladder.counters)[step.name.lower()] == 1
    assert sum(asdict(bench.ladder.counters).values()) == 1


def test_with_room_again_the_next_call_is_whole() -> None:
    bench = Bench()
    steps = []
    for left_ms in (20.0, 3.0, 0.0, 20.0):
        bench.call(left_ms)
        steps.append(bench.ladder.step)
    assert steps == [Step.CHOSEN, Step.FEWER, Step.NONE, Step.CHOSEN]


def test_what_the_filter_does_with_the_samples_must_fit_as_well() -> None:
    bench = Bench(filter_ms=4.0 * (OVERHEAD + S) / OVERHEAD)
    assert bench.call(20.0) == S
    bench.call(20.0 - 4.0)  # 8 ms of samples and 5.6 of filter, with the margin 17
    assert bench.ladder.step is Step.CHEAPER


def test_a_proposal_over_its_own_budget_is_not_taken_though_there_is_time() -> None:
    bench = Bench()
    bench.ladder.budget_ns = 5 * MS
    bench.call(100.0)
    assert bench.ladder.step is Step.CHEAPER


def test_a_machine_that_slows_down_is_noticed_and_that_it_recovers_as_well() -> None:
    bench = Bench()
    assert bench.call(12.0) == S
    bench.slower = 3.0
    for _ in range(100):
        bench.call(12.0)
    assert bench.ladder.counters.chosen < 10  # a try now and then
    bench.slower = 1.0
    for _ in range(100):
        bench.call(12.0)
    assert bench.ladder.step is Step.CHOSEN


def test_a_machine_that_was_busy_at_start_costs_no_samples_afterwards() -> None:
    """What others did then is not what the filter's work costs."""
    bench = Bench(filter_ms=2.0)
    for bench.slower in (20.0, 1.0, 20.0, 15.0, 20.0):
        bench.call(float("inf"))
    bench.ladder.settle()
    bench.slower = 1.0
    for _ in range(10):
        assert bench.call(15.0) == S
    assert bench.ladder.counters.chosen == 10


def test_one_long_pause_by_others_does_not_condemn_a_proposal() -> None:
    bench = Bench()
    bench.slower = 1000.0
    bench.call(20.0)
    bench.slower = 1.0
    bench.call(30.0)
    assert bench.ladder.step is Step.CHOSEN


def test_what_takes_now_more_now_less_is_given_more_than_its_mean() -> None:
    steady, unsteady = Bench(), Bench()
    for call in range(40):
        steady.call(100.0)
        unsteady.slower = 0.5 if call % 2 else 1.5
        unsteady.call(100.0)
    for bench in (steady, unsteady):
        bench.call(12.0)
    assert steady.ladder.step is Step.CHOSEN
    assert unsteady.ladder.step is Step.CHEAPER


def test_where_nothing_ever_fits_the_fewest_samples_still_come_now_and_then() -> None:
    bench = Bench()
    came = [bench.call(0.1) > 0 for _ in range(3 * (PATIENCE + 1))]
    assert came == 3 * [*PATIENCE * [False], True]


def test_a_lone_proposal_without_a_clock_is_always_whole() -> None:
    chosen = Slow("table", Clock(), lambda: 1.0)
    ladder = Ladder([Rung(Step.CHOSEN, chosen)], lambda: 0)
    for _ in range(10):
        assert len(ladder.propose(np.zeros(1), np.ones(1, bool), S, RNG)) == S
    assert chosen.asked == 10 * [S]
