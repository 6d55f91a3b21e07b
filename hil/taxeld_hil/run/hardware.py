"""A scenario on real hardware: the operator's robot moves and touches, the daemon listens to the
device, and its messages are graded as far as they can be.

Nothing is injected into a real skin; the daemon and a subscriber can be killed. Without the
object's true pose, its accuracy and what misleads are not graded.
"""

import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import zmq

from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld_hil.grade.grade import Grade, Run, grade
from taxeld_hil.grade.judge import Judge
from taxeld_hil.rig.bench import write_config
from taxeld_hil.rig.rig import BEFORE_S, SETTLE_S
from taxeld_hil.run.contact_table import HEADER, OBJECT, ContactTable
from taxeld_hil.run.listener import Listener, Say
from taxeld_hil.run.processes import Processes
from taxeld_hil.scenario import settings
from taxeld_hil.scenario.scenario import KINDS, Scenario
from taxeld_hil.world.world import load_model

TARGETS = {"can": "can", "serial": "native", "slcan": "slcan"}  # the target's kind → transport
POSSIBLE = ("daemon_killed", "subscriber_dead")
START_S = 60.0  # until the first scan
STEP_MS = 20


@dataclass(frozen=True, slots=True)
class Site:
    """The hardware of a run."""

    target: str  # can:can0, serial:/dev/ttyACM0 or slcan:/dev/ttyACM0
    poses: str  # the robot's endpoint; empty: the sensor stands still
    truth: Poses | None  # (3,) of the object in the robot's world
    limit_s: float  # longest that the operator may take

    @property
    def channel(self) -> str:
        """Raises SetupError where the target is malformed."""
        kind, colon, channel = self.target.partition(":")
        if kind not in TARGETS or not colon or not channel:
            named = ", ".join(f"{name}:DEVICE" for name in TARGETS)
            raise SetupError(f"--target: '{self.target}' is none of sim, {named}")
        return channel

    def placed(self, scenario: Scenario) -> Scenario:
        """The scenario over this transport."""
        return scenario.over(TARGETS[self.target.partition(":")[0]])


def graded(
    name: str, scenario: Scenario, site: Site, directory: Path, place: Path, say: Say
) -> Grade:
    """Run until the scenario's contacts have been made and the daemon has recovered from its
    faults, or the time is up; sockets are in `place`.

    Raises:
        SetupError: the target is malformed, a process failed, or no scan came.
    """
    channel = site.channel
    scenario = site.placed(scenario.one_link())
    scene = load_model(scenario).scene
    config = settings.text(scenario, 0, channel, site.poses, place)
    written = write_config(directory, config + '[log]\nlevel = "warning"\n')
    not_injected = tuple(kind for kind in KINDS if kind not in POSSIBLE)
    judge = Judge(scenario, scene, site.truth, not_injected, lambda _: [])
    with ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        stream = f"ipc://{place}/stream"
        listener = Listener(stack, context, stream, judge, ContactTable(scene, site.truth), say)
        processes = Processes(written, stream, scenario)
        stack.callback(processes.kill)
        processes.start()
        say(f"touch the object {scenario.contacts} times, after a second of touching nothing")
        say(HEADER + OBJECT * (len(scenario.known) > 1))
        judge.end(_listen(scenario, site, listener, processes))
        processes.stop()
    run = Run(name, 0, site.target, "real", scenario.transport)
    return grade(run, judge, [], None)


def _listen(scenario: Scenario, site: Site, listener: Listener, processes: Processes) -> float:
    """Follow the run to its end; → scenario time [s]."""
    began = time.monotonic()
    start_s: float | None = None
    faults = [fault for fault in scenario.fault if fault.kind in POSSIBLE]
    wait_s = scenario.expect.recovery_s + SETTLE_S
    last_s = max((fault.end_s + wait_s for fault in faults), default=0.0)
    while True:
        listener.wait(STEP_MS)
        now = time.monotonic()
        t = BEFORE_S if start_s is None else now - start_s
        listener.receive(t)
        if start_s is None and listener.begun:
            start_s = now
        on = {fault.kind for fault in faults if fault.at_s <= t < fault.end_s}
        for event in processes.act(lambda kind, on=on: kind in on):  # type: ignore[misc]
            if event == "subscriber printed":
                listener.judge.came_back("subscriber_dead", t)
        if start_s is None and now - began > START_S:
            raise SetupError(
                f"{site.target}: no scan came within {START_S:g} s; check the skin "
                "with 'taxeld-hil accept'"
            )
        last = listener.table.last
        done = bool(last) and last["contacts"] >= scenario.contacts and not last["contact"]
        if t > site.limit_s or (done and (t > last_s or listener.judge.has_recovered(t))):
            return t
