"""`taxeld-hil run`: a scenario in simulation, on either clock, or on hardware; and its report."""

import tempfile
from pathlib import Path

from taxeld_hil.grade import report
from taxeld_hil.grade.grade import Grade
from taxeld_hil.run import hardware
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.run.hardware import Site
from taxeld_hil.run.listener import Say
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario.scenario import Scenario


def simulate(
    name: str, scenario: Scenario, seed: int, directory: Path, say: Say, channel: str, *, fake: bool
) -> Grade:
    """Run a scenario in simulation; `channel`: the CAN interface, where that is the transport.

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
    return reported(grade, directory, say)


def on_hardware(name: str, scenario: Scenario, site: Site, directory: Path, say: Say) -> Grade:
    """Run a scenario on a real skin and robot.

    Raises:
        SetupError: the target is malformed, a process failed, or no scan came.
    """
    with tempfile.TemporaryDirectory(prefix="taxeld-") as place:
        grade = hardware.graded(name, scenario, site, directory, Path(place), say)
    return reported(grade, directory, say)


def reported(grade: Grade, directory: Path, say: Say) -> Grade:
    """Write and print the grade; → the same."""
    report.write(grade, directory)
    for line in report.lines(grade):
        say(line)
    return grade
