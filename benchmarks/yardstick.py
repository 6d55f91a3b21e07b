"""How fast this machine is at the work that a scan takes: a unit for figures of different machines.

    python benchmarks/yardstick.py

A loop of Python's own steps and of numpy's calls on arrays as short as a skin, always the same.
"""

import time

import numpy as np

STEPS, TAXELS = 120, 80  # about a millisecond on a server's core of 2023
ROUNDS = 31


def loop_ms() -> float:
    """CPU time of a loop, median over rounds."""
    times = [time.process_time()]
    for _ in range(ROUNDS):
        work()
        times.append(time.process_time())
    return 1e3 * float(np.median(np.diff(times)))


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


if __name__ == "__main__":
    print(f"{loop_ms():.3f} ms of CPU time a loop")
