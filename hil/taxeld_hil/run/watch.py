"""A subscriber: one line a contact, and at the end the error and the latencies."""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld import command_line
from taxeld.arrays import Poses
from taxeld.estimator.estimate import Status
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.source import session
from taxeld.stream import messages, sockets
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.world import load_model

HEADER = (
    "contact  taxels  modes       p  radius [mm]  likeliest x, y, yaw [mm, mm, deg]  error [mm]"
)
OBJECT = "  object"  # ends the header where the daemon knows several
SILENT_S = 5.0  # without a message for so long, a line says so: daemons start in seconds


@dataclass(slots=True)
class ContactTable:
    """Follows the streams of a daemon; the truth, where it is known, grades the estimates. Where
    the daemon knows several objects, each line ends with the likeliest of them."""

    scene: Scene
    truth: Poses | None
    most_taxels: int = 0
    last: dict[str, Any] = field(default_factory=dict)
    lat_us: dict[str, list[float]] = field(default_factory=dict)
    sure_after: int = 0  # contacts after which it was sure and stayed so; 0: it is not
    _in_contact: bool = False

    def on_taxels(self, message: dict[str, Any]) -> None:
        self.most_taxels = max(self.most_taxels, sum(z > 0 for z in message["z"]))

    def on_estimate(self, message: dict[str, Any]) -> str | None:
        """The line of a contact that has just ended."""
        self.last = message
        is_sure = message["status"] == Status.CONVERGED
        self.sure_after = (self.sure_after or message["contacts"]) if is_sure else 0
        if message["lat_us"]["skin"] > 0:
            for stage, value in message["lat_us"].items():
                self.lat_us.setdefault(stage, []).append(value)
        ended = self._in_contact and not message["contact"]
        self._in_contact = message["contact"]
        if not ended:
            return None
        line = (
            f"{message['contacts']:7d} {self.most_taxels:7d} {len(message['modes']):6d} "
            f"{message['p']:7.1%} {1e3 * message['radius_m']:12.1f}    {_pose(message['map'])}"
        )
        self.most_taxels = 0
        line = line if self.truth is None else f"{line} {self.error_mm():16.1f}"
        several = len(message["objects"]) > messages.ALONE
        return f"{line}  {messages.object_of(message)}" if several else line

    def error_mm(self) -> float:
        """Symmetry-aware ADD of the last likeliest pose; not a number where there is none."""
        if self.truth is None or not self.last or not self.last["valid"]:
            return float("nan")
        pose = self.last["map"]
        estimate = np.array([pose["x"], pose["y"], pose["theta"]])
        return 1e3 * add_m(self.scene, estimate, self.truth)[1]

    def final(self) -> str:
        """A line on the last error."""
        about = "mean distance of the object's points, up to its symmetry"
        return f"final error {self.error_mm():.1f} mm ({about})"

    def sure(self) -> str:
        """After how many contacts the daemon became sure, as it still is."""
        return f"sure after {self.sure_after} contacts" if self.sure_after else "not sure"

    def latencies(self) -> list[str]:
        """A line a stage: median, 99th percentile and maximum of ticks with a scan."""
        lines = ["latency [ms]   median     p99     max"]
        for stage in messages.STAGES:
            p50, p99, top = np.percentile(self.lat_us.get(stage, [0.0]), (50, 99, 100)) / 1e3
            lines.append(f"{stage:12s} {p50:8.2f} {p99:7.2f} {top:7.2f}")
        return lines


def watch(
    endpoint: str, bundle: str, layout: str, truth: Path | None, say: Callable[[str], None]
) -> None:
    """Say a line for each contact of a daemon that knows `bundle`, until a signal asks for the end.
    `truth`: CSV of the object's poses.

    Raises:
        SetupError: the endpoint, the bundle, the layout or the truth cannot be used.
    """
    scene = load_model(Scenario(bundle, layout=layout)).scene
    at = np.array(session.read_poses(truth)[-1][1:]) if truth else None
    table, stopping = ContactTable(scene, at), command_line.stopping()
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        sockets.connect(socket, endpoint, "--endpoint")
        for topic in (messages.ESTIMATE, messages.TAXELS):
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        begun, silent_s = False, time.monotonic() + SILENT_S
        while not stopping():
            if socket.poll(50):
                if not begun:
                    say(HEADER)
                begun = True
                if line := _receive(socket, table):
                    say(line)
            elif not begun and time.monotonic() > silent_s:
                silent_s = math.inf
                sys.stderr.write(f"nothing comes from {endpoint} so far; is a daemon there?\n")
    if begun:
        say("\n".join([*table.latencies(), *([] if at is None else [table.final()])]))


def _receive(socket: zmq.Socket[Any], table: ContactTable) -> str | None:
    """Take one message; → a line to print, if it ended a contact."""
    topic, body, *_ = socket.recv_multipart()  # over TCP maybe without the time
    if topic == messages.TAXELS:
        table.on_taxels(msgpack.unpackb(body))
    elif topic == messages.ESTIMATE:
        return table.on_estimate(msgpack.unpackb(body))
    return None


def _pose(pose: dict[str, float]) -> str:
    degrees = np.degrees(pose["theta"])
    return f"({pose['x'] * 1e3:7.1f}, {pose['y'] * 1e3:7.1f}, {degrees:6.1f})"
