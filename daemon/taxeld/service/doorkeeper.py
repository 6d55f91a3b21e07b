"""Starts the door, watches it, and starts it again; the loop never waits for it.

A worker starts the process. The loop takes the new pair, and sees an end, at its next look.
"""

import logging
import math
import signal
import socket
import subprocess
import sys
from dataclasses import replace

from taxeld.config.tables import Config
from taxeld.door.settings import REFUSED, Settings
from taxeld.errors import SetupError
from taxeld.service.surroundings import MACHINE, DoorProcess, Surroundings
from taxeld.stream.link import Link

FIRST_S = 30.0  # for the first door to be ready
STOP_S = 2.0  # for a door to end by itself
EARLY_S = 10.0
EARLY_PAUSE_S = 0.2  # before a door that ended so early is started again
REFUSED_PAUSE_S = 5.0  # the same where it cannot serve, or cannot be started
LOOK_S = 0.01
QUEUE_S = 2.0  # messages of all topics that wait for a slow subscriber
QUEUE_LEAST = 40  # messages
CHANGE_GROUP = "taxeld-control"  # its members may tare, reset and give priors
log = logging.getLogger(__name__)


class Doorkeeper:
    """One door of a daemon after another."""

    def __init__(self, settings: Settings, around: Surroundings = MACHINE) -> None:
        self.starts = 0
        self._settings, self._around = settings, around
        self._process: DoorProcess | None = None  # of the door that the loop has met,
        self._met_s = 0.0  # and when
        self._new: tuple[DoorProcess, socket.socket] | None = None  # a door that it has not met
        self._next_s = math.inf  # when the next one is started
        self._link = Link({}, lambda *_: None, {})  # another one from `wait` on
        self._was_ready = False
        self._fault = ""  # why the last start failed
        self._worker = around.worker("doorkeeper")
        if settings.is_needed:
            self._begin(around.monotonic())

    def wait(self, link: Link) -> None:
        """Join `link` to the doors, and wait until the first one is ready.

        Raises:
            SetupError: it cannot serve an endpoint, or does not start.
        """
        self._link, around = link, self._around
        until_s = around.monotonic() + FIRST_S
        while self._settings.is_needed and not link.is_ready:
            self.look(around.monotonic())
            if link.fault or self._fault or around.monotonic() > until_s:
                raise SetupError(
                    link.fault or self._fault or "the door does not start; see its log"
                )
            around.sleep(LOOK_S)
        self._was_ready = True

    def look(self, now_s: float) -> None:
        """Give the link a new door, read its packets, and see to a door that has ended, or that the
        link dropped; `now_s` is monotonic."""
        link = self._link
        if self._new is not None:
            (self._process, end), self._new = self._new, None
            self._met_s = now_s
            link.attach(end, now_s)
        link.look(now_s)
        if link.fault and self._was_ready:
            log.error("door: %s", link.fault)
            link.fault = ""
        if self._process is not None:
            self._watch(self._process, now_s)
        elif now_s >= self._next_s and not self._worker.behind and self._new is None:
            self._begin(now_s)

    def close(self) -> None:
        """Let the door go, and wait until it has ended."""
        self._next_s = math.inf
        self._link.detach()
        self._worker.close(STOP_S)
        if self._new is not None:
            self._process, end = self._new
            end.close()
        if self._process is None:
            return
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(STOP_S)

    def _begin(self, now_s: float) -> None:
        self._next_s = now_s + REFUSED_PAUSE_S  # if it cannot be started
        self._worker.give(self._start)

    def _start(self) -> None:
        try:
            self._new = self._around.start_door(self._settings)
        except OSError as error:
            self._fault = f"the door cannot be started: {sys.executable} ({error.strerror})"
            log.error("%s", self._fault)
        else:
            self.starts += 1

    def _watch(self, process: DoorProcess, now_s: float) -> None:
        """Kill a door that the link dropped; have one that has ended started again."""
        if self._link.end is None:
            process.kill()
        status = process.poll()
        if status is None:
            return
        self._process, self._next_s = None, now_s + REFUSED_PAUSE_S
        if status != REFUSED:
            ending = signal.strsignal(-status) if status < 0 else f"status {status}"
            log.warning("door: ended: %s; it is started again", ending)
            self._next_s = now_s + EARLY_PAUSE_S * (now_s < self._met_s + EARLY_S)


def settings_of(config: Config) -> tuple[Settings, Settings]:
    """What a configuration asks of the door, and of the relay."""
    scans_hz = 1000.0 / config.source.period_ms
    messages_hz = 2.0 * scans_hz + max(config.publish.rate_hz, scans_hz)
    queue = max(round(QUEUE_S * messages_hz), QUEUE_LEAST)
    door = replace(
        poses_alone(config),
        publish=config.publish.endpoints,
        control=config.control.endpoint,
        change_group=CHANGE_GROUP,
        queue=queue,
        estimates=bool(config.scene.names),
    )
    return door, Settings(
        publish=config.relay.publish,
        control=config.relay.control,
        is_relay=True,
        change=config.relay.change,
        queue=queue,
        estimates=door.estimates,
        keys=config.curve.directory,
    )


def poses_alone(config: Config) -> Settings:
    """Settings of a door that hears the configured robot and array, and serves nobody."""
    return Settings(
        robot=config.sensor_pose.endpoint,
        topics=config.topics,
        array=next((bus.endpoint for bus, _ in config.buses if bus.kind == "array"), ""),
        keys=config.curve.directory,
    )
