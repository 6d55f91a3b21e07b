"""Starts the door, watches it, and starts it again; the loop never waits for it.

A thread waits for the process to end. The loop takes the new pair at its next look.
"""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from taxeld.config.tables import Config
from taxeld.door.settings import OOM_SCORE, Settings
from taxeld.errors import SetupError
from taxeld.source.array_source import ArraySource
from taxeld.source.source import Source
from taxeld.stream import pair
from taxeld.stream.link import Link

FIRST_S = 30.0  # for the first door to be ready
STOP_S = 2.0  # for a door to end by itself
PAUSES_S = (0.0, 0.1, 0.2, 0.4)  # before a door that ended early is started again
EARLY_S = 10.0
REFUSED_S = 5.0  # the same pause where the door said that it cannot serve
REFUSED = 2  # exit status of such a door
LOOK_S = 0.01
QUEUE_S = 2.0  # messages of all topics that wait for a slow subscriber
QUEUE_LEAST = 40  # messages
CHANGE_GROUP = "taxeld-control"  # its members may tare, reset and give priors
LOOPS_OWN = ("NOTIFY_", "WATCHDOG_", "LISTEN_", "STATE_DIRECTORY")  # variables of the environment
log = logging.getLogger(__name__)


class _Started(NamedTuple):
    """A door that the loop has not met."""

    end: socket.socket  # the loop's end of the pair
    process: subprocess.Popen[bytes]


class Doorkeeper:
    """The doors of one daemon, one after another."""

    def __init__(self, settings: Settings) -> None:
        self.starts = 0
        self._settings = settings
        self._stops = threading.Event()
        self._started: deque[_Started] = deque()  # by this thread for the loop's
        self._process: subprocess.Popen[bytes] | None = None  # the one that the loop has met
        self._refused: subprocess.Popen[bytes] | None = None  # the last that has stated a fault
        self._was_ready = False
        self._fault = ""  # why the last start failed
        self._thread = threading.Thread(target=self._keep, name="doorkeeper", daemon=True)
        if settings.is_needed:
            self._thread.start()

    def wait(self, link: Link) -> None:
        """Until the first door is ready.

        Raises:
            SetupError: it cannot serve an endpoint, or does not start.
        """
        until_s = time.monotonic() + FIRST_S
        while self._settings.is_needed and not link.is_ready:
            self.look(link, time.monotonic())
            if link.fault or self._fault or time.monotonic() > until_s:
                raise SetupError(
                    link.fault or self._fault or "the door does not start; see its log"
                )
            time.sleep(LOOK_S)
        self._was_ready = True

    def look(self, link: Link, now_s: float) -> None:
        """Give `link` a restarted door, read its packets, and kill a door that `link` dropped;
        `now_s` is monotonic."""
        while self._started:
            end, self._process = self._started.popleft()
            link.attach(end, now_s)
        link.look(now_s)
        if link.fault and self._was_ready:
            log.error("door: %s", link.fault)
            link.fault, self._refused = "", self._process
        if link.end is None and self._process is not None:
            self._process.kill()
            self._process = None

    def close(self) -> None:
        """Wait until the door, whose pair has been let go, has ended."""
        self._stops.set()
        unmet = [*self._started]
        for started in unmet:
            started.end.close()
        if self._thread.ident is None:
            return
        self._thread.join(STOP_S)
        met = [self._process] if self._process else []
        for process in (*met, *(started.process for started in unmet)):
            if self._thread.is_alive():
                process.kill()
        self._thread.join(STOP_S)

    def _keep(self) -> None:
        early = 0
        while not self._stops.is_set():
            began_s = time.monotonic()
            status = self._run()
            if self._stops.is_set():
                return
            early = early + 1 if time.monotonic() < began_s + EARLY_S else 0
            pause_s = REFUSED_S if status == REFUSED else PAUSES_S[min(early, len(PAUSES_S) - 1)]
            if status != REFUSED:
                log.warning("door: %s; it is started again", _ending(status))
            self._stops.wait(pause_s)

    def _run(self) -> int:
        """A door, from its start to its end; → its exit status."""
        try:
            process = self._start()
        except OSError as error:
            self._fault = f"the door cannot be started: {sys.executable} ({error.strerror})"
            log.error("%s", self._fault)
            return REFUSED
        status = process.wait()
        return REFUSED if process is self._refused else status  # `look` may have killed it

    def _start(self) -> subprocess.Popen[bytes]:
        """Raises OSError where no descriptor or no process is left."""
        loops, doors = pair.open_pair()
        command = [sys.executable, "-P", "-m", "taxeld.door", str(doors.fileno())]
        try:
            process = subprocess.Popen(  # noqa: S603  (our own module)
                [*command, self._settings.dump()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[doors.fileno()],
                env=_environment(),
            )
        except OSError:
            loops.close()
            raise
        finally:
            doors.close()
        self.starts += 1
        with contextlib.suppress(OSError):  # at once: a door that is starting has the loop's score
            Path(f"/proc/{process.pid}/oom_score_adj").write_text(str(OOM_SCORE), encoding="ascii")
        self._started.append(_Started(loops, process))
        if self._stops.is_set():
            loops.close()
        return process


def settings_of(config: Config) -> Settings:
    """What a configuration asks of the door."""
    scans_hz = 1000.0 / config.source.period_ms
    messages_hz = 2.0 * scans_hz + max(config.publish.rate_hz, scans_hz)
    return Settings(
        publish=config.publish.endpoints,
        control=config.control.endpoint,
        change_group=CHANGE_GROUP,
        robot=config.sensor_pose.endpoint,
        topics=_topics_of(config),
        array=_array_of(config),
        queue=max(round(QUEUE_S * messages_hz), QUEUE_LEAST),
        relay_publish=config.relay.publish,
        relay_control=config.relay.control,
        relay_change=config.relay.change,
        estimates=bool(config.scene.names),
        keys=config.curve.directory,
    )


def poses_alone(config: Config) -> Settings:
    """Settings of a door that hears the configured robot and array, and serves nobody."""
    return Settings(
        publish=(),
        control="",
        change_group="",
        robot=config.sensor_pose.endpoint,
        topics=_topics_of(config),
        array=_array_of(config),
        queue=QUEUE_LEAST,
        keys=config.curve.directory,
    )


def _topics_of(config: Config) -> tuple[str, ...]:
    return config.topics


@contextlib.contextmanager
def array_heard(source: Source, endpoint: str) -> Iterator[None]:
    """Meanwhile a door hears an array for a source that nothing but its poller looks after.

    Raises:
        SetupError: the endpoint cannot be used.
    """
    if not isinstance(source, ArraySource):
        yield
        return
    alone = Settings((), "", "", "", QUEUE_LEAST, array=endpoint)
    link = Link({}, lambda *_: None, {})
    with contextlib.closing(Doorkeeper(alone)) as door:
        link.on_array = source.hear
        source.look = partial(door.look, link)
        try:
            door.wait(link)
            yield
        finally:
            link.detach()


def _array_of(config: Config) -> str:
    found = (bus.endpoint for bus, _ in config.buses if bus.kind == "array")
    return next(found, "")


def _environment() -> dict[str, str]:
    """Without what is the loop's alone: the service manager's sockets and directories."""
    return {name: value for name, value in os.environ.items() if not name.startswith(LOOPS_OWN)}


def _ending(status: int) -> str:
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"ended by signal {-status}"
