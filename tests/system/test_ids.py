"""The ids of tests: the same in each process, so that several can share the tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DEADLINE_S = 600.0  # all tests take 15 s of a processor to collect
COLLECT_LATER = """
import sys, time
real = time.time
time.time = lambda: real() + 1e6
import pytest
sys.exit(pytest.main(["--collect-only", "-q", "-p", "no:cacheprovider", *sys.argv[1:]]))
"""


def test_another_process_collects_the_same_tests_at_a_later_time(
    request: pytest.FixtureRequest,
) -> None:
    """Collects anew the files of this run alone, with another order of hashes."""
    ours = [item.nodeid for item in request.session.items]
    files = dict.fromkeys(node.partition("::")[0] for node in ours)
    done = subprocess.run(
        [sys.executable, "-c", COLLECT_LATER, *files],
        cwd=ROOT,
        env={**os.environ, "PYTHONHASHSEED": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=DEADLINE_S,
    )
    theirs = dict.fromkeys(line for line in done.stdout.splitlines() if "::" in line)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    chosen = set(ours)  # a run may have left out a part of a file's tests
    assert [node for node in theirs if node in chosen] == ours
