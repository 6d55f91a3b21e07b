"""The virtual skin on a moving robot, in real time; it records the session as it goes."""

import select
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld import bundle, layout, messages, session
from taxeld.config import SkinConfig
from taxeld.se2 import Poses
from taxeld_hil import robot
from taxeld_hil.adapter import CanAdapter, SlcanAdapter
from taxeld_hil.scenario import Scenario
from taxeld_hil.world import World
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

POSE_PERIOD_S = 0.01
IDLE_S = 1.5  # untouched at the start: the daemon's baseline takes 20 scans of 50 ms
REST_S = 0.5  # at the end, so that the last touch is estimated
ANSWER_S = 20.0  # without a host that starts the skin for so long, there is none


@dataclass(frozen=True, slots=True)
class Emulation:
    """A scenario with a seed, ready to run."""

    scenario: Scenario
    seed: int

    def run(self, endpoint: str, where: Path | str, directory: Path) -> bool:
        """Serve the skin, publish the robot's poses on `endpoint`, record into `directory`.

        `where`: a link that will point to a pseudo-terminal, or a CAN interface's name; → whether a
        host came and stayed to the end.
        """
        scenario = self.scenario
        skin = layout.load(scenario.layout)
        model = bundle.load(scenario.bundle, skin, SkinConfig().full_scale_depth_m).model
        modules = wired(skin.uid.tolist())
        world = World(scenario, model, modules, self.seed)
        path = robot.plan(scenario, model, world.truth, self.seed)
        ihb = VirtualIhb(modules)
        with (
            zmq.Context() as context,
            context.socket(zmq.PUB) as poses,
            session.Recorder(directory, moves=True) as recorder,
            (
                CanAdapter(ihb, recorder.take, where)
                if isinstance(where, str)
                else SlcanAdapter(ihb, recorder.take)
            ) as adapter,
        ):
            poses.setsockopt(zmq.LINGER, 0)
            poses.bind(endpoint)
            _write_truth(directory, world.truth)
            if isinstance(adapter, SlcanAdapter):
                Path(where).symlink_to(adapter.device)
            return _serve(adapter, world, path, poses, recorder)


def _serve(
    adapter: SlcanAdapter | CanAdapter,
    world: World,
    path: robot.Path,
    poses: zmq.Socket[Any],
    recorder: session.Recorder,
) -> bool:
    began = time.monotonic()
    next_pose_s, start_s = began, None
    while True:
        select.select([adapter], [], [], 0.002)
        now, wall = time.monotonic(), time.time()
        adapter.serve(wall)
        if start_s is None and adapter.ihb.auto_sync:
            start_s = now + IDLE_S
        along = 0.0 if start_s is None else now - start_s
        pose = path.at(along)
        if now >= next_pose_s:
            next_pose_s = max(next_pose_s + POSE_PERIOD_S, now)
            x, y, theta = (float(v) for v in pose)
            body = msgpack.packb({"t": wall, "x": x, "y": y, "theta": theta})
            poses.send_multipart((messages.SENSOR_POSE, body, b"%.6f" % wall), zmq.NOBLOCK)
            recorder.pose(wall, x, y, theta)
        if adapter.ihb.due(now):
            for command, payload in adapter.ihb.sensor_data(world.counts(pose, along)):
                adapter.send(command, payload, wall)
        if start_s is None and now - began > ANSWER_S:
            return False
        if along > path.duration_s + REST_S:
            return adapter.ihb.auto_sync


def _write_truth(directory: Path, truth: Poses) -> None:
    row = ",".join(f"{v:.6f}" for v in (time.time(), *truth))
    header = ",".join(session.POSE_COLUMNS)
    (directory / session.TRUTH).write_text(f"{header}\n{row}\n", encoding="ascii")
