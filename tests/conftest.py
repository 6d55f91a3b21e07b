"""Processes of tests have one thread each, as they share few cores: many small operations take
longer by two. Set before numpy is imported; what a test starts inherits it.

`TAXELD_TEST_SEED=k make test` draws all random numbers of tests anew, those of the code that is
tested too; only what runs in processes of its own draws as ever.
"""

import os
from typing import Any

import pytest
from hypothesis import settings

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

SEED = int(os.environ.get("TAXELD_TEST_SEED", "0"))
generator = np.random.default_rng


def shifted(seed: Any = None) -> np.random.Generator:
    if isinstance(seed, int | np.integer):
        seed = (seed,)
    return generator((SEED, *seed) if isinstance(seed, tuple | list) else seed)


if SEED:
    np.random.default_rng = shifted  # type: ignore[assignment]

# A busy machine makes no test fail by the time it takes
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")


def pytest_configure(config: pytest.Config) -> None:
    if config.option.hypothesis_seed is None:
        config.option.hypothesis_seed = SEED


def pytest_report_header() -> str:
    return f"TAXELD_TEST_SEED={SEED}"
