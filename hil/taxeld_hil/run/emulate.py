"""The virtual skin on a moving robot, in real time and alone; it records the session as it goes."""

import time
from pathlib import Path

import zmq

from taxeld.door.binding import bound
from taxeld_hil.rig.bench import Bench, recorded
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario.scenario import Scenario

ANSWER_S = 60.0  # until a host starts the skin


def emulate(
    scenario: Scenario, seed: int, endpoint: str, where: Path | str, directory: Path
) -> bool:
    """Serve the skin, publish the robot's poses on `endpoint`, record into `directory`; → whether a
    host came and stayed to the end.

    `where`: a link that will point to a pseudo-terminal, or a CAN interface's name.

    Raises:
        SetupError: there is no such interface, the endpoint is taken, or the directory holds a
            session.
    """
    rig = Rig(scenario.one_link(), seed)
    with zmq.Context() as context, context.socket(zmq.XPUB) as poses:
        poses.setsockopt(zmq.LINGER, 0)
        with bound(poses, endpoint, "--poses"), recorded(rig, where, poses, directory) as bench:
            return _serve(bench)


def _serve(bench: Bench) -> bool:
    began = time.monotonic()
    while bench.t < bench.rig.duration_s:
        time.sleep(0.002)
        bench.step()
        if bench.start_s is None and time.monotonic() - began > ANSWER_S:
            return False
    return not bench.was_stopped
