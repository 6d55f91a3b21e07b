"""The virtual skin on a moving robot, in real time and alone; it records the session as it goes."""

import time
from pathlib import Path

import zmq

from taxeld import session, sockets
from taxeld_hil.bench import Bench, write_truth
from taxeld_hil.rig import Rig
from taxeld_hil.scenario import Scenario

ANSWER_S = 20.0  # without a host that starts the skin for so long, there is none


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
    rig = Rig(scenario, seed)
    with (
        zmq.Context() as context,
        context.socket(zmq.XPUB) as poses,
        session.Recorder(directory, moves=True) as recorder,
    ):
        poses.setsockopt(zmq.LINGER, 0)
        sockets.bind(poses, endpoint, "--poses")
        write_truth(directory, rig)
        bench = Bench(rig, where, poses, recorder)
        try:
            return _serve(bench)
        finally:
            bench.close()


def _serve(bench: Bench) -> bool:
    began = time.monotonic()
    while bench.t < bench.rig.duration_s:
        time.sleep(0.002)
        bench.step()
        if bench.start_s is None and time.monotonic() - began > ANSWER_S:
            return False
    return not bench.was_stopped
