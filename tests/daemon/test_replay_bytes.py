"""A recorded session replays to the bytes that it always gave: what is tidied up changes nothing.

Bytes depend on how the processor and the C library round, so both are held fixed; where that cannot
be had the test is skipped. Who changes what the estimator does, on purpose, writes the new digests
here and says so.
"""

import hashlib
import platform
from pathlib import Path

import numpy as np
import pytest

from ..rig.processes import replayed

SESSION = Path(__file__).parent / "session"  # four contacts of a mug, over a native serial line
FIXED = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENBLAS_NUM_THREADS": "1",
    "TAXELD_COMPILED": "0",
}
DIGESTS = {
    'proposal = "table"': "fb3553756ca3ed8e",
    'proposal = "manifold"\ninjection = "paper"': "5a1d230c8cb821bc",
    'proposal = "table"\nmotion = "push"': "6a9c41adea901b2a",
    'proposal = "manifold"\nparticles = 300': "29f152e554d5f7ca",
}


def same_rounding() -> bool:
    cpu = Path("/proc/cpuinfo")
    return (
        platform.machine() == "x86_64"
        and platform.libc_ver() == ("glibc", "2.36")
        and np.__version__.startswith("2.4.")
        and " avx2 " in cpu.read_text(encoding="ascii", errors="replace")
    )


@pytest.mark.skipif(not same_rounding(), reason="another processor, C library or numpy")
@pytest.mark.parametrize(("filter_keys", "digest"), DIGESTS.items())
def test_a_recorded_session_gives_the_bytes_it_gave_before(
    tmp_path: Path, filter_keys: str, digest: str
) -> None:
    text = (SESSION / "config.toml").read_text(encoding="utf-8")
    config = tmp_path / "config.toml"
    config.write_text(f"{text}{filter_keys}\n", encoding="utf-8")
    printed = replayed(SESSION, "--config", config, env=FIXED)
    assert printed.count(b"\n") == 254
    assert hashlib.sha256(printed).hexdigest()[:16] == digest
