"""Costs of calls, on a clock of the test's own."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taxeld.arrays import Poses
from taxeld_training.samplers import costs

READINGS = np.zeros((6, 4))


class Machine:
    """A clock, and a cache that holds what the last sampler called needs."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.cached = ""

    def call(self, name: str, warm_ms: int, cold_ms: int) -> None:
        self.now_ns += (warm_ms if self.cached == name else cold_ms) * 1_000_000
        self.cached = name


class Fake:
    """A sampler that takes 1 000 ms when first called."""

    def __init__(self, name: str, machine: Machine, warm_ms: int, cold_ms: int) -> None:
        self.name = name
        self.calls = 0
        self._machine, self._ms = machine, (warm_ms, cold_ms)

    def propose(
        self,
        z: NDArray[np.float64],
        live: NDArray[np.bool_],
        n: int,
        rng: np.random.Generator,  # noqa: ARG002
    ) -> Poses:
        assert z.shape == live.shape
        self.calls += 1
        self._machine.call(self.name, *((1000, 1000) if self.calls == 1 else self._ms))
        return np.zeros((n, 3))


@pytest.fixture
def samplers(monkeypatch: pytest.MonkeyPatch) -> list[Fake]:
    machine = Machine()
    monkeypatch.setattr("time.thread_time_ns", lambda: machine.now_ns)
    return [Fake("a", machine, 1, 5), Fake("b", machine, 2, 3)]


def test_cold_calls_of_all_samplers_alternate(samplers: list[Fake]) -> None:
    assert costs.cold_ms(samplers, READINGS, np.random.default_rng(0)) == [5.0, 3.0]
    assert [sampler.calls for sampler in samplers] == [6, 6]


def test_warm_calls_of_a_sampler_follow_each_other(samplers: list[Fake]) -> None:
    assert costs.warm_ms(samplers, READINGS, np.random.default_rng(0)) == [1.0, 2.0]
    assert [sampler.calls for sampler in samplers] == [6, 6]
    for sampler in samplers:
        sampler.calls = 1  # no sampler is new; the first call is cold all the same
    assert costs.warm_ms(samplers, READINGS[:2], np.random.default_rng(0)) == [1.0, 2.0]
