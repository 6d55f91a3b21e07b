"""A program of ours has one thread of numpy's libraries: on a robot's computer theirs fight for the
loop's core, and a touch of 640 taxels costs several times the CPU."""

import os
import subprocess
import sys

import pytest

from taxeld.command_line import ONE_THREAD

ASKED = """
import sys
from {module} import main
assert "numpy" not in sys.modules, "too late: its threads are there"
try:
    main(["--version"])
except SystemExit:
    pass
import os
print(*(os.environ[name] for name in {names}))
"""


@pytest.mark.parametrize("module", ["taxeld.cli", "taxeld_hil.cli", "taxeld_ros2.cli"])
@pytest.mark.parametrize(("given", "expected"), [({}, "1 1 1"), ({ONE_THREAD[0]: "2"}, "2 1 1")])
def test_numpys_libraries_have_one_thread_unless_the_environment_says_otherwise(
    module: str, given: dict[str, str], expected: str
) -> None:
    environ = {k: v for k, v in os.environ.items() if k not in ONE_THREAD}
    command = [sys.executable, "-c", ASKED.format(module=module, names=ONE_THREAD)]
    done = subprocess.run(
        command, check=False, env={**environ, **given}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == expected
