"""A program of ours has one thread of numpy's libraries: on a robot's computer theirs fight for the
loop's core, and a touch of 640 taxels costs several times the CPU."""

import os

import pytest

from taxeld.command_line import ONE_THREAD

from ..rig.processes import python

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
    code = ASKED.format(module=module, names=ONE_THREAD)
    done = python(code, env={**environ, **given})
    assert done.stdout.splitlines()[-1] == expected
