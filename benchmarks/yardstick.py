"""How fast this machine is at the work that a scan takes: a unit for figures of different machines.

    python benchmarks/yardstick.py

A loop of Python's own steps and of numpy's calls on arrays as short as a skin, always the same.
"""

import re
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

STEPS = 120  # about a millisecond on a server's core of 2023
ROUNDS = 15
TAXELS = 80
UNITS = (  # end of a figure's name → milliseconds of CPU time in one of its unit
    (re.compile(r"CPU us$"), 1e-3),
    (re.compile(r"CPU ms$"), 1.0),
    (re.compile(r"CPU s$"), 1e3),
    (re.compile(r": %$|% of one core$"), 10.0),  # loops a second
)


class Loop:
    """The loop's CPU time, over rounds that are spread over a run: a machine's speed changes with
    its load."""

    def __init__(self) -> None:
        self._spent_ms: list[float] = []

    @property
    def ms(self) -> float:
        """Median over the last rounds, before and after."""
        return statistics.median(self._spent_ms[-2 * ROUNDS :])

    def measure(self) -> None:
        for _ in range(ROUNDS):
            start = time.process_time_ns()
            work()
            self._spent_ms.append((time.process_time_ns() - start) / 1e6)

    @contextmanager
    def around(self) -> Iterator[None]:
        """Measured before what is done within, and after."""
        self.measure()
        yield
        self.measure()

    def ratio(self, figure: str, measured: float) -> float | None:
        """The same in loops, for a share of a core in loops a second; None for what is no CPU
        time."""
        for pattern, ms in UNITS:
            if pattern.search(figure):
                return measured * ms / self.ms
        return None


def work() -> None:
    """One loop."""
    rng = np.random.default_rng(0)
    counts, baseline = rng.normal(10_000.0, 34.0, TAXELS), np.full(TAXELS, 10_000.0)
    seen: dict[str, float] = {}
    for step in range(STEPS):
        over = counts - baseline
        pressed = over > 5.0 * step
        level = np.clip(np.where(pressed, over, 0.0), 0.0, 1.0)
        seen[f"step {step % 7}"] = float(level.sum()) + sum(range(40))
        baseline = baseline + 0.01 * over
    assert len(seen) == min(STEPS, 7)


if __name__ == "__main__":
    loop = Loop()
    loop.measure()
    print(f"{loop.ms:.3f} ms of CPU time a loop")
