"""`taxeld-hil run`: a scenario in simulation, on either clock, or on hardware; and its report."""

import tempfile
from collections.abc import Callable
from pathlib import Path

from taxeld_hil import hardware, report
from taxeld_hil.fake import FakeRun
from taxeld_hil.grade import Grade
from taxeld_hil.hardware import Site
from taxeld_hil.live import LiveRun
from taxeld_hil.scenario import Scenario

Say = Callable[[str], None]


def simulate(
    name: str, scenario: Scenario, seed: int, directory: Path, say: Say, channel: str, *, fake: bool
) -> Grade:
    """In simulation; `channel`: the CAN interface, where that is the transport.

    Raises:
        SetupError: a process failed, or there is no such interface.
    """
    directory.mkdir(parents=True, exist_ok=True)
    if fake:
        grade = FakeRun(scenario, seed).graded(name)
    else:
        with tempfile.TemporaryDirectory(prefix="taxeld-") as place:
            run = LiveRun(name, scenario, seed, directory, channel, say)
            grade = run.graded(Path(place))
    return told(grade, directory, say)


def on_hardware(name: str, scenario: Scenario, site: Site, directory: Path, say: Say) -> Grade:
    """On a real skin and robot.

    Raises:
        SetupError: the target is none, a process failed, or no scan came.
    """
    with tempfile.TemporaryDirectory(prefix="taxeld-") as place:
        grade = hardware.graded(name, scenario, site, directory, Path(place), say)
    return told(grade, directory, say)


def told(grade: Grade, directory: Path, say: Say) -> Grade:
    """The grade, once it has been written and said."""
    report.write(grade, directory)
    for line in report.lines(grade):
        say(line)
    return grade
