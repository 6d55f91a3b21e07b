"""The bridge: what the daemon publishes goes out as ROS 2 topics, and the skin's pose comes in.

Estimates are passed on first; particles and markers after them, so that they hold up no pose.
"""

import contextlib
import logging
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from taxeld.arrays import Floats
from taxeld.service.notify import Notifier
from taxeld.stream import messages
from taxeld_ros2 import convert
from taxeld_ros2 import ros_types as ros
from taxeld_ros2.dds import RELIABLE, Participant, last
from taxeld_ros2.markers import markers
from taxeld_ros2.poses_in import FromTopic, FromTransforms, SensorPose
from taxeld_ros2.stream import PoseOutput, Stream

STEP_MS = 50
SILENT_S = 2.0  # without an estimate for so long, no daemon is there
DIAGNOSTICS_S = 1.0  # between two, while the status stays
MARKERS_S = 0.1
DEPTH = 10  # messages kept for a reader, as ROS 2's own publishers do

log = logging.getLogger(f"taxeld.{__name__}")  # which the command has written


@dataclass(frozen=True, slots=True)
class Settings:
    """What is bridged."""

    stream: str  # where the daemon or its relay publishes
    frame: str = "world"  # frame_id of the object's poses
    prefix: str = "taxeld"  # of the topics
    z_m: float = 0.0  # height of the poses
    domain: int | None = None  # None: ROS_DOMAIN_ID
    keys: Path | None = None
    markers: bool = True
    sensor_endpoint: str = ""  # where the daemon expects the robot
    sensor_frames: tuple[str, str] | None = None  # the skin's pose from transforms,
    sensor_topic: str = ""  # or from a topic


class Bridge:
    """Opened, until `close`."""

    def __init__(self, settings: Settings) -> None:
        """Raises SetupError: something of it cannot be used; a daemon need not be there."""
        self.stopping = False
        self.forwarded = 0
        self._settings = settings
        self._estimate: dict[str, Any] = {}
        self._health: dict[str, Any] = {}
        self._cloud: dict[str, Any] = {}
        self._outline: Floats | None = None
        self._heard_s = time.monotonic()
        self._is_silent = False
        self._next_diagnostics_s = self._next_markers_s = -math.inf
        self._shown_seq = -1
        with contextlib.ExitStack() as opened:
            context: zmq.Context[Any] = opened.enter_context(zmq.Context())
            self._stream = Stream(context, settings.stream, settings.keys, settings.markers)
            opened.callback(self._stream.close)
            dds = Participant(settings.domain)
            name, qos = settings.prefix.strip("/"), last(DEPTH, RELIABLE)
            self._pose = dds.writer(f"{name}/pose", ros.PoseWithCovarianceStamped, qos)
            self._modes = dds.writer(f"{name}/modes", ros.PoseArray, qos)
            self._markers = dds.writer(f"{name}/markers", ros.MarkerArray, last(1, RELIABLE))
            self._diagnostics = dds.writer("diagnostics", ros.DiagnosticArray, qos)
            self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            opened.callback(os.close, self._wake)
            self._sensor = self._sensor_pose(context, dds, opened)
            self._poller = zmq.Poller()
            self._poller.register(self._stream.socket, zmq.POLLIN)
            self._poller.register(self._wake, zmq.POLLIN)
            self._opened = opened.pop_all()

    def run(self) -> None:
        """Until `stop`.

        Raises:
            VersionError: the daemon speaks another version of the stream.
        """
        notifier = Notifier()
        notifier.ready()
        try:
            while not self.stopping:
                self.step()
                notifier.tick(time.monotonic(), self._status_line)
        finally:
            notifier.stopping()

    def stop(self) -> None:
        self.stopping = True

    def step(self) -> None:
        """Wait a moment, and pass on what has come."""
        self._poller.poll(STEP_MS)
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        if self._sensor is not None:
            self._sensor.serve()
        for topic, message in self._stream.take():
            self._on_message(topic, message)
        now_s = time.monotonic()
        self._watch(now_s)
        self._draw(now_s)

    def close(self) -> None:
        self._opened.close()

    def _sensor_pose(
        self, context: "zmq.Context[Any]", dds: Participant, opened: contextlib.ExitStack
    ) -> SensorPose | None:
        settings = self._settings
        if settings.sensor_frames is None and not settings.sensor_topic:
            return None
        output = PoseOutput(context, settings.sensor_endpoint)
        opened.callback(output.close)
        if settings.sensor_frames is not None:
            return SensorPose(FromTransforms(dds, *settings.sensor_frames, self._woken), output)
        return SensorPose(FromTopic(dds, settings.sensor_topic, self._woken), output)

    def _woken(self) -> None:
        """By a thread of DDS: a pose has come."""
        with contextlib.suppress(BlockingIOError, OSError):
            os.eventfd_write(self._wake, 1)

    def _on_message(self, topic: bytes, message: dict[str, Any]) -> None:
        if topic == messages.ESTIMATE:
            self._on_estimate(message)
        elif topic == messages.HEALTH:
            self._health = message
        elif topic == messages.PARTICLES:
            self._cloud = message
        elif topic == messages.INFO:
            self._outline = np.array(message["outline"])

    def _on_estimate(self, estimate: dict[str, Any]) -> None:
        """Poses are published while they may be used, and for each estimate of a scan."""
        settings, before = self._settings, self._estimate
        if estimate["valid"] and estimate["t"] != before.get("t"):
            frame, z_m = settings.frame, settings.z_m
            self._pose.write(convert.pose_with_covariance(estimate, frame, z_m))
            self._modes.write(convert.modes(estimate, frame, z_m))
            self.forwarded += 1
        if estimate["status"] != before.get("status"):
            self._next_diagnostics_s = -math.inf
        self._estimate = estimate
        self._heard_s = time.monotonic()

    def _watch(self, now_s: float) -> None:
        """Say whether a daemon is heard, and how it is."""
        silent = now_s - self._heard_s > SILENT_S
        if silent != self._is_silent:
            self._is_silent, self._next_diagnostics_s = silent, -math.inf
            where = self._settings.stream
            if silent:
                self._estimate, self._health, self._cloud = {}, {}, {}
                log.warning("no daemon is heard at %s; is 'taxeld run' there? Waiting", where)
            else:
                log.warning("a daemon is heard at %s", where)
        if now_s >= self._next_diagnostics_s and (self._estimate or silent):
            self._next_diagnostics_s = now_s + DIAGNOSTICS_S
            name = f"{self._settings.prefix.strip('/')}: estimate"
            told = convert.diagnostics(self._estimate, self._health, time.time(), name)
            self._diagnostics.write(told)

    def _status_line(self, _: float) -> str:
        heard = "no daemon is heard" if self._is_silent else "a daemon is heard"
        return f"{heard}, {self.forwarded} poses passed on"

    def _draw(self, now_s: float) -> None:
        """Markers, once something has changed and no more often than they can be seen."""
        estimate = self._estimate
        if not self._settings.markers or self._outline is None or now_s < self._next_markers_s:
            return
        if not estimate or estimate["seq"] == self._shown_seq:
            return
        self._next_markers_s, self._shown_seq = now_s + MARKERS_S, estimate["seq"]
        frame, z_m = self._settings.frame, self._settings.z_m
        self._markers.write(markers(estimate, self._cloud, self._outline, frame, z_m))
