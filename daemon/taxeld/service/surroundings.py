"""The machine that a daemon runs on: clocks, waiting, threads, devices and processes.

All that the daemon learns of time, and all that it starts, comes from here, so that a simulation
runs the whole daemon on a machine of its own.
"""

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Protocol

from taxeld.config.tables import Config, SourceConfig
from taxeld.door.settings import OOM_SCORE, Settings
from taxeld.layout.layout import Layout
from taxeld.proposals import bundle
from taxeld.proposals.bundle import Bundle
from taxeld.service import clock, realtime
from taxeld.service.clock import Readable, Ready
from taxeld.source.device import Device
from taxeld.source.opening import open_device
from taxeld.stream import pair
from taxeld.worker import Job, Worker

LOOPS_OWN = ("NOTIFY_", "WATCHDOG_", "LISTEN_", "STATE_DIRECTORY")  # variables of the environment


class DoorProcess(Protocol):
    """What the loop does with a door's process, as subprocess.Popen has it."""

    pid: int

    def poll(self) -> int | None: ...

    def wait(self, timeout: float) -> int: ...

    def kill(self) -> None: ...


class Surroundings:
    """This machine. Seconds are Unix time (`unix`) or monotonic."""

    def unix(self) -> float:
        return time.time()

    def monotonic(self) -> float:
        return time.monotonic()

    def work_ns(self) -> int:
        """Of a clock for how long work takes."""
        return time.perf_counter_ns()

    def cpu_ns(self) -> int:
        """Processor time of this thread."""
        return time.thread_time_ns()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def wait(
        self, devices: Sequence[Readable | None], door: Readable | None, until_s: float
    ) -> Ready:
        """As `clock.wait`."""
        return clock.wait(devices, door, until_s)

    def realtime(self, priority: int) -> contextlib.AbstractContextManager[realtime.RealTime]:
        """As `realtime.thread`."""
        return realtime.thread(priority)

    def worker(self, name: str, turn: Job = lambda: None, every_s: float | None = None) -> Worker:
        return Worker(name, turn, every_s)

    def open_device(self, config: SourceConfig) -> Device:
        """As `opening.open_device`."""
        return open_device(config)

    def bundles(self, config: Config, skins: Sequence[Layout]) -> list[Bundle]:
        """Of each object; `skins`: of each link. Raises SetupError where one cannot be used."""
        return bundle.load_all(config.scene, skins, config.skin.full_scale_depth_m)

    def start_door(self, settings: Settings) -> tuple[DoorProcess, socket.socket]:
        """A new door's process, and the loop's end of the pair. Raises OSError where no descriptor
        or no process is left."""
        loops, doors = pair.open_pair()
        command = [sys.executable, "-P", "-m", "taxeld.door.process", str(doors.fileno())]
        try:
            process = subprocess.Popen(  # noqa: S603  (our own module)
                [*command, json.dumps(asdict(settings))],
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
        with contextlib.suppress(OSError):  # at once: a door that is starting has the loop's score
            Path(f"/proc/{process.pid}/oom_score_adj").write_text(str(OOM_SCORE), encoding="ascii")
        return process, loops


MACHINE = Surroundings()
