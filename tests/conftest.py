"""Processes of tests have one thread each, as they share few cores: many small operations take
longer by two. Set before numpy is imported; what a test starts inherits it.

`TAXELD_TEST_SEED=k make test` draws all random numbers of tests anew, those of the code that is
tested too; only what runs in processes of its own draws as ever.
"""

import os
import resource
from typing import Any

import pytest
from hypothesis import settings
from hypothesis.internal.conjecture import engine

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

HUNT_BYTES = 8 << 30  # of address space of a process
HUNT_SHRINKS_S = 60  # in place of 300
SEED = int(os.environ.get("TAXELD_TEST_SEED", "0"))
generator = np.random.default_rng


def shifted(seed: Any = None) -> np.random.Generator:
    if isinstance(seed, int | np.integer):
        seed = (seed,)
    return generator((SEED, *seed) if isinstance(seed, tuple | list) else seed)


if SEED:
    np.random.default_rng = shifted  # type: ignore[assignment]

# The same examples everywhere, and on a busy machine no test fails by the time it takes
settings.register_profile("same", derandomize=True, deadline=None, print_blob=True)
# `make check` draws others, and more of them
settings.register_profile("hunt", settings.get_profile("same"), derandomize=False, max_examples=400)
settings.load_profile("same")


def pytest_configure(config: pytest.Config) -> None:
    """A hunt ends with an error where a property asks for too much memory, and soon."""
    if config.option.hypothesis_profile == "hunt":
        resource.setrlimit(resource.RLIMIT_AS, (HUNT_BYTES, HUNT_BYTES))
        engine.MAX_SHRINKING_SECONDS = HUNT_SHRINKS_S


def pytest_report_header() -> str:
    return f"TAXELD_TEST_SEED={SEED}"
