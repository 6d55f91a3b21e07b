"""Descriptors: a daemon that is allowed too few says so at once, and takes all that it may."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from taxeld.service import descriptors

from .test_cli import configuration

DEADLINE_S = 60.0


def limited(soft: int, hard: int, *command: str) -> "subprocess.CompletedProcess[str]":
    set_limit = f"import resource, os, sys\nresource.setrlimit(7, ({soft}, {hard}))\n"
    run = "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    assert resource.RLIMIT_NOFILE == 7
    return subprocess.run(
        [sys.executable, "-c", set_limit + run, *command],
        capture_output=True, text=True, check=False, timeout=DEADLINE_S,
    )  # fmt: skip


@pytest.mark.parametrize("allowed", [16, 20, descriptors.NEEDED - 1])
def test_a_daemon_that_may_open_too_little_is_one_line_and_status_2(
    tmp_path: Path, allowed: int
) -> None:
    path = configuration(tmp_path)
    done = limited(allowed, allowed, "-m", "taxeld.cli", "run", str(path))
    assert done.returncode == 2
    assert done.stderr == (
        f"{allowed} open files are allowed, and the daemon needs {descriptors.NEEDED}: "
        "raise the limit (LimitNOFILE= of the unit, or ulimit -n)\n"
    )


def test_a_limit_that_may_be_raised_is_raised() -> None:
    code = (
        "import resource; from taxeld.service import descriptors; descriptors.ensure(); "
        "print(resource.getrlimit(resource.RLIMIT_NOFILE))"
    )
    done = limited(20, 4096, "-c", code)
    assert done.stdout == "(4096, 4096)\n", done.stderr
