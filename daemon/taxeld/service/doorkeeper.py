"""Starts the door, watches it, and starts it again; the loop never waits for it.

A thread waits for the process to end. The loop takes the new pair at its next look.
"""

import contextlib
import json
import logging
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

from taxeld.config.tables import Config
from taxeld.door.settings import OOM_SCORE, REFUSED, Settings
from taxeld.errors import SetupError
from taxeld.stream import pair
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
LOOPS_OWN = ("NOTIFY_", "WATCHDOG_", "LISTEN_", "STATE_DIRECTORY")  # variables of the environment
log = logging.getLogger(__name__)


class Doorkeeper:
    """One door of a daemon after another."""

    def __init__(self, settings: Settings) -> None:
        self.starts = 0
        self._settings = settings
        self._stops = threading.Event()
        # doors that the loop has not met: their process, and the loop's end of the pair
        self._started: queue.SimpleQueue[tuple[subprocess.Popen[bytes], socket.socket]] = (
            queue.SimpleQueue()
        )
        self._newest: subprocess.Popen[bytes] | None = None  # written by the thread alone
        self._process: subprocess.Popen[bytes] | None = None  # the one that the loop has met
        self._link = Link({}, lambda *_: None, {})  # another one from `wait` on
        self._was_ready = False
        self._fault = ""  # why the last start failed
        self._thread = threading.Thread(target=self._keep, name="doorkeeper", daemon=True)
        if settings.is_needed:
            self._thread.start()

    def wait(self, link: Link) -> None:
        """Join `link` to the doors, and wait until the first one is ready.

        Raises:
            SetupError: it cannot serve an endpoint, or does not start.
        """
        self._link = link
        until_s = time.monotonic() + FIRST_S
        while self._settings.is_needed and not link.is_ready:
            self.look(time.monotonic())
            if link.fault or self._fault or time.monotonic() > until_s:
                raise SetupError(
                    link.fault or self._fault or "the door does not start; see its log"
                )
            time.sleep(LOOK_S)
        self._was_ready = True

    def look(self, now_s: float) -> None:
        """Give the link a restarted door, read its packets, and kill a door that the link dropped;
        `now_s` is monotonic."""
        link = self._link
        while not self._started.empty():  # this thread alone takes from it
            self._process, end = self._started.get()
            link.attach(end, now_s)
        link.look(now_s)
        if link.fault and self._was_ready:
            log.error("door: %s", link.fault)
            link.fault = ""
        if link.end is None and self._process is not None:
            self._process.kill()
            self._process = None

    def close(self) -> None:
        """Let the door go, and wait until it has ended."""
        self._stops.set()  # first: a door that ends is started again
        self._link.detach()
        if self._thread.ident is None:
            return
        while not self._started.empty():
            self._started.get()[1].close()
        self._thread.join(STOP_S)
        if self._thread.is_alive() and self._newest is not None:
            self._newest.kill()
            self._thread.join(STOP_S)

    def _keep(self) -> None:
        while not self._stops.is_set():
            began_s = time.monotonic()
            try:
                status = self._start().wait()
            except OSError as error:
                self._fault = f"the door cannot be started: {sys.executable} ({error.strerror})"
                log.error("%s", self._fault)
                status = REFUSED
            if self._stops.is_set():
                return
            if status == REFUSED:
                self._stops.wait(REFUSED_PAUSE_S)
                continue
            ending = signal.strsignal(-status) if status < 0 else f"status {status}"
            log.warning("door: ended: %s; it is started again", ending)
            if time.monotonic() < began_s + EARLY_S:
                self._stops.wait(EARLY_PAUSE_S)

    def _start(self) -> subprocess.Popen[bytes]:
        """Raises OSError where no descriptor or no process is left."""
        loops, doors = pair.open_pair()
        command = [sys.executable, "-P", "-m", "taxeld.door.process", str(doors.fileno())]
        try:
            process = subprocess.Popen(  # noqa: S603  (our own module)
                [*command, json.dumps(asdict(self._settings))],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[doors.fileno()],
                env={k: v for k, v in os.environ.items() if not k.startswith(LOOPS_OWN)},
            )
        except OSError:
            loops.close()
            raise
        finally:
            doors.close()
        self.starts += 1
        with contextlib.suppress(OSError):  # at once: a door that is starting has the loop's score
            Path(f"/proc/{process.pid}/oom_score_adj").write_text(str(OOM_SCORE), encoding="ascii")
        self._newest = process
        self._started.put((process, loops))
        if self._stops.is_set():
            loops.close()
        return process


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
