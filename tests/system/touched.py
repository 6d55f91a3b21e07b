"""A daemon as a process behind a virtual skin that is touched all the time, recorded.

As a program it is the skin, and does the lines `unplug`, `plug` and `quiet` of its standard input;
after `quiet` it writes how many scans it has sent.
"""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from taxeld.layout import read as layouts  # noqa: E402
from taxeld.stream import client  # noqa: E402
from taxeld_protocol.modules import wired  # noqa: E402
from tests.rig.clocks import PATIENCE_S  # noqa: E402
from tests.rig.processes import door_of, replayed  # noqa: E402
from tests.rig.virtual_hub import VirtualHub  # noqa: E402

SKIN = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
IDLE_SCANS = 30  # the baseline takes 20
IDLE_COUNTS, NOISE, PRESS = 10_000.0, 30.0, 8000.0
LAST_S = 10.0  # for the last that the skin has sent to be used


class Touched:
    """`taxeld run` with a recording, its skin, and what both say."""

    def __init__(
        self, place: Path, settings: str = "", *, before: str = "", session: Path | None = None
    ) -> None:
        """`settings`: more tables of the configuration; `before`: what the shell does first;
        `session`: where the recording goes, if not into `place`."""
        self.stream, self.control = f"ipc://{place}/stream", f"ipc://{place}/control"
        self.session = session or place / "session"
        self._log = place / "log"
        config = place / "touched.toml"
        config.write_text(
            f'[skin]\nlayout = "{SKIN}"\n[source]\nkind = "can"\ninterface = "slcan"\n'
            f'channel = "{place}/skin"\n[scene]\nbundle = "box"\n'
            f'[filter]\nproposal = "manifold"\n[publish]\nendpoints = ["{self.stream}"]\n'
            f'[control]\nendpoint = "{self.control}"\n{settings}',
            encoding="utf-8",
        )
        self._skin = subprocess.Popen(
            [sys.executable, __file__, str(place / "skin")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._skin.stdout is not None
        self._skin.stdout.readline()
        command = [sys.executable, "-m", "taxeld.cli", "run", "--record", self.session, config]
        environ = {k: v for k, v in os.environ.items() if k != "NOTIFY_SOCKET"}
        shell = ["sh", "-c", f'{before}\nexec "$@"', "sh"]
        with self._log.open("wb") as log:
            self._loop = subprocess.Popen(
                [*shell, *map(str, command)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environ,
            )
        self.pid = self._loop.pid
        self.last: dict[str, Any] = {}  # health, before it was stopped

    @property
    def log(self) -> str:
        return self._log.read_text(encoding="utf-8")

    def status(self, timeout_s: float = 2.0) -> dict[str, Any] | None:
        """The answer; None: there was none in time, or the loop was silent."""
        answer = client.ask(self.control, "status", timeout_s=timeout_s)
        return answer if answer and answer.get("ok") else None

    def until_touched(self) -> dict[str, Any]:
        """Until contact is felt; → the status then."""
        deadline = time.monotonic() + PATIENCE_S
        while self._loop.poll() is None and time.monotonic() < deadline:
            status = self.status()
            if status and status["estimate"].get("contacts"):
                return status
            time.sleep(0.05)
        raise AssertionError(f"it never felt a touch: {self.log}")

    def health(self) -> dict[str, Any]:
        """By its log, so that no peer is needed."""
        before = self.log.count("health: {")
        os.kill(self.pid, signal.SIGUSR1)
        deadline = time.monotonic() + PATIENCE_S
        while (lines := self.log.split("health: ")[1:])[before:] == [] or "\n" not in lines[-1]:
            assert time.monotonic() < deadline, "the loop says nothing"
            time.sleep(0.02)
        made: dict[str, Any] = json.loads(lines[-1].splitlines()[0])
        return made

    def door(self) -> int:
        """The number of its process; 0: it is not there."""
        return door_of(self.pid)

    def kill_door(self) -> bool:
        """Whether there was one."""
        door = self.door()
        with contextlib.suppress(ProcessLookupError):
            if door:
                os.kill(door, signal.SIGKILL)
        return door > 0

    def tell_skin(self, line: str) -> None:
        assert self._skin.stdin is not None
        self._skin.stdin.write(line + "\n")
        self._skin.stdin.flush()

    def stop(self, *, whole: bool = True) -> int:
        """Have the skin fall silent, and then end the daemon; → the scans that the skin has sent.
        `whole`: all of them are waited for."""
        assert self._skin.stdout is not None
        self.tell_skin("quiet")
        sent = int(self._skin.stdout.readline())
        deadline = time.monotonic() + (LAST_S if whole else 0.0)
        while time.monotonic() < deadline:
            self.last = self.health()
            if self.last["source"]["scans"] >= sent:
                break
            time.sleep(0.2)
        self._loop.terminate()
        status = self._loop.wait(PATIENCE_S)
        assert status == 0, self.log
        return sent

    def replay(self) -> list[dict[str, Any]]:
        """An estimate for each scan of the recording."""
        return [json.loads(line) for line in replayed(self.session).splitlines()]

    def close(self) -> None:
        for process in (self._loop, self._skin):
            process.kill()
            process.wait()
        for pipe in (self._skin.stdin, self._skin.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()


@contextlib.contextmanager
def touched(place: Path, settings: str = "", **options: Any) -> Iterator[Touched]:
    made = Touched(place, settings, **options)
    try:
        yield made
    finally:
        made.close()


def counts_of(number: int, channels: int) -> list[int]:
    """A press that moves around, and now and then is none."""
    rng = np.random.default_rng(number)
    counts = IDLE_COUNTS + rng.normal(0.0, NOISE, channels)
    if number >= IDLE_SCANS and number % 40 < 36:
        first = 11 * (number // 10 % 8)  # of a module, whose last channel is its temperature
        counts[first + 3 : first + 6] += PRESS * (0.6 + 0.4 * np.sin(number / 7.0))
    return counts.astype(int).tolist()


def main() -> None:
    """The skin."""
    modules = wired(layouts.load(SKIN).uid.tolist())
    channels = sum(module.channels for module in modules)
    with VirtualHub(Path(sys.argv[1]), modules) as hub:
        say("")
        is_quiet = is_away = False
        while True:
            if select.select([sys.stdin], [], [], 0.002)[0]:
                line = sys.stdin.readline().strip()
                if not line:
                    break
                match line:
                    case "quiet":
                        is_quiet = True
                        say(str(hub.scans))
                    case "unplug":
                        hub.unplug()
                    case "plug":
                        hub.plug()
                is_away = line == "unplug"
            if is_away:
                continue
            if is_quiet:
                hub.answer(time.monotonic())
            else:
                hub.serve(time.monotonic(), lambda number: counts_of(number, channels))


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
