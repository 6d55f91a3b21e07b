"""The bridge: what the daemon publishes goes out as ROS 2 topics, and the skin's pose comes in.

Estimates are passed on first, markers after them, so that these hold up no pose.
"""

import contextlib
import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from taxeld.arrays import Floats
from taxeld.service.notify import Notifier
from taxeld.stream import messages
from taxeld.view import ros
from taxeld.view.streams import Subscriber
from taxeld_ros2.dds import Participant
from taxeld_ros2.markers import markers
from taxeld_ros2.poses_in import FromTopic, FromTransforms, SensorPose

STEP_MS = 50
SILENT_S = 2.0  # after this long without an estimate no daemon is there
DIAGNOSTICS_S = 1.0  # period of the diagnostics while the status stays
MARKERS_S = 0.1  # shortest period of the markers
DEPTH = 10  # messages kept for a reader, as ROS 2's own publishers do
TOPICS = (messages.ESTIMATE, messages.HEALTH, messages.INFO, messages.PARTICLES)

log = logging.getLogger(f"taxeld.{__name__}")  # the command writes the logs of taxeld


@dataclass(frozen=True, slots=True)
class BridgeSettings:
    """Settings of the bridge, from its command line and the daemon's configuration."""

    stream: str  # endpoint where the daemon publishes
    frame: str = "world"  # frame_id of the object's poses
    prefix: str = "taxeld"  # of the topics
    z_m: float = 0.0  # height of the poses
    keys: Path | None = None
    sensor_endpoint: str = ""  # where the daemon expects the robot
    sensor_frames: Sequence[str] | None = None  # the world's and the skin's, of transforms
    sensor_topic: str = ""  # in place of transforms


class Bridge:
    """Opened, until `close`."""

    def __init__(self, settings: BridgeSettings) -> None:
        """A daemon need not be there. Raises SetupError where a setting cannot be used."""
        self._settings = settings
        self._forwarded = 0
        self._last: dict[bytes, dict[str, Any]] = {}  # message of each topic
        self._outlines: list[Floats] = []  # by the numbers of the objects
        self._heard_s = time.monotonic()
        self._is_silent: bool | None = None  # None until a daemon is heard, or missed
        self._next_diagnostics_s = self._next_markers_s = -math.inf
        with contextlib.ExitStack() as opened:
            self._streams = Subscriber(settings.stream, settings.keys, TOPICS, "--stream")
            opened.callback(self._streams.close)
            dds, name = Participant(), settings.prefix
            kind = "geometry_msgs/PoseWithCovarianceStamped"
            self._pose = dds.writer(f"{name}/pose", kind, DEPTH)
            self._modes = dds.writer(f"{name}/modes", "geometry_msgs/PoseArray", DEPTH)
            self._markers = dds.writer(f"{name}/markers", "visualization_msgs/MarkerArray", 1)
            kind = "diagnostic_msgs/DiagnosticArray"
            self._diagnostics = dds.writer("diagnostics", kind, DEPTH)
            self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            opened.callback(os.close, self._wake)
            self._sensor = self._sensor_pose(dds, opened)
            self._poller = zmq.Poller()
            self._poller.register(self._streams.socket, zmq.POLLIN)
            self._poller.register(self._wake, zmq.POLLIN)
            self._opened = opened.pop_all()

    def run(self, stopping: Callable[[], bool]) -> None:
        """Until `stopping`.

        Raises:
            SetupError: the daemon speaks another version of the stream.
        """
        notifier = Notifier()
        notifier.ready()
        try:
            while not stopping():
                self._step()
                notifier.tick(time.monotonic(), self._status_line)
        finally:
            notifier.stopping()

    def close(self) -> None:
        self._opened.close()

    def _sensor_pose(self, dds: Participant, opened: contextlib.ExitStack) -> SensorPose | None:
        settings = self._settings
        source: FromTransforms | FromTopic
        if settings.sensor_frames is not None:
            world, skin = settings.sensor_frames
            source = FromTransforms(dds, world, skin, self._woken)
        elif settings.sensor_topic:
            source = FromTopic(dds, settings.sensor_topic, self._woken)
        else:
            return None
        context: zmq.Context[Any] = opened.enter_context(zmq.Context())
        sensor = SensorPose(context, settings.sensor_endpoint, source)
        opened.callback(sensor.close)
        return sensor

    def _woken(self) -> None:
        """Called by a thread of DDS when a pose has come."""
        with contextlib.suppress(BlockingIOError, OSError):
            os.eventfd_write(self._wake, 1)

    def _step(self) -> None:
        self._poller.poll(STEP_MS)
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        if self._sensor is not None:
            self._sensor.serve()
        is_new = False
        for topic, message in self._streams.wait(0.0):
            if topic == messages.ESTIMATE:
                is_new = True
                self._on_estimate(message)
            elif topic == messages.INFO:
                self._outlines = [np.array(each["outline"]) for each in message["objects"]]
            self._last[topic] = message
        now_s = time.monotonic()
        self._watch(now_s)
        if is_new and self._outlines and now_s >= self._next_markers_s:
            self._next_markers_s = now_s + MARKERS_S
            estimate, cloud = self._last[messages.ESTIMATE], self._last.get(messages.PARTICLES, {})
            frame, z_m = self._settings.frame, self._settings.z_m
            self._markers.write(markers(estimate, cloud, self._outlines, frame, z_m))

    def _on_estimate(self, estimate: dict[str, Any]) -> None:
        """Pose and modes of a scan's estimate are published while they may be used."""
        before, settings = self._last.get(messages.ESTIMATE, {}), self._settings
        t, frame, z_m = estimate["t"], settings.frame, settings.z_m
        if estimate["valid"] and t != before.get("t"):
            if ros.is_usable(estimate):
                self._pose.write(ros.pose_with_covariance(estimate, frame, z_m))
                self._forwarded += 1
            self._modes.write(ros.pose_array(t, estimate["modes"], frame, z_m))
        if any(estimate[key] != before.get(key) for key in ("status", "why")):
            self._next_diagnostics_s = -math.inf
        self._heard_s = time.monotonic()

    def _watch(self, now_s: float) -> None:
        silent = now_s - self._heard_s > SILENT_S
        if silent != self._is_silent and (silent or messages.ESTIMATE in self._last):
            self._is_silent, self._next_diagnostics_s = silent, -math.inf
            where, name = self._settings.stream, self._settings.prefix
            if silent:
                self._last.clear()
                log.warning("no daemon is heard at %s; is 'taxeld run' there? Waiting", where)
            else:
                served = f"/{name}/pose, /{name}/modes, /{name}/markers and /diagnostics"
                log.info("ready: a daemon is heard at %s; published are %s", where, served)
        estimate = self._last.get(messages.ESTIMATE, {})
        if now_s >= self._next_diagnostics_s and (estimate or silent):
            self._next_diagnostics_s = now_s + DIAGNOSTICS_S
            health = self._last.get(messages.HEALTH)
            name = f"{self._settings.prefix}: estimate"
            self._diagnostics.write(ros.diagnostics(time.time(), name, estimate, health))

    def _status_line(self, _: float) -> str:
        heard = "a daemon is heard" if self._is_silent is False else "no daemon is heard"
        return f"{heard}, {self._forwarded} poses passed on"
