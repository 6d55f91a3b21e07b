"""What the checks look at: units as systemd sees them, and estimates of a skin that is touched."""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import msgpack
import numpy as np
import zmq

from taxeld.config.tables import ControlConfig, PublishConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.model.symmetry import add_m
from taxeld.proposals import bundle
from taxeld.source import session
from taxeld.stream import client, topics
from taxeld_protocol.frames import Frame

PATIENCE_S = 180.0  # an emulated processor is some twenty times slower
GOOD_MM = 10.0
# touched until the check ends: an emulated processor loses some contacts
SCENARIO = 'bundle = "box"\ncontacts = 40\nphysics = "scene"\n'
COMMAND = "/usr/lib/taxeld/bin/taxeld"
POSES = "tcp://127.0.0.1:9874"
OVER_TCP = "tcp://127.0.0.1:9872"

CONFIG = f"""\
[source]
kind = "can"
channel = "%s"
[scene]
bundle = "box"
[sensor_pose]
endpoint = "{POSES}"
[loop]
rate_hz = 10.0
[filter]
proposal = "density-64"
[relay]
publish = ["{OVER_TCP}"]
"""


def sh(command: str) -> str:
    """What a shell command prints; AssertionError with its complaint where it fails."""
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}: {done.stderr.strip() or done.returncode}"
    return done.stdout.strip()


def until(what: str, true: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
    deadline = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.2)


class Unit:
    """An instance of the service."""

    def __init__(self, instance: str) -> None:
        self.instance = instance
        self.name = f"taxeld@{instance}"
        self.config = Path(f"/etc/taxeld/{instance}.toml")

    def drop_in(self, *settings: str) -> None:
        """Settings of this instance's own, until the next boot."""
        place = Path(f"/run/systemd/system/{self.name}.service.d/test.conf")
        place.parent.mkdir(parents=True)
        place.write_text("\n".join(["[Service]", *settings, ""]), encoding="utf-8")
        sh("systemctl daemon-reload")

    def show(self, key: str) -> str:
        return sh(f"systemctl show -P {key} {self.name}")

    def leave_memory(self, mb: int) -> None:
        """Until it is started again, MemoryMax= is so much more than what its processes have and
        cannot give back; where that is less, the kernel ends them."""
        group = Path(f"/sys/fs/cgroup{self.show('ControlGroup')}")
        limit = group / "memory.max"
        assert limit.read_text("ascii").strip() == self.show("MemoryMax")  # of the unit as it is
        text = (group / "memory.stat").read_text("ascii")
        stat = {key: int(value) for key, value in (line.split() for line in text.splitlines())}
        has = int((group / "memory.current").read_text("ascii"))
        kept = has - stat["active_file"] - stat["inactive_file"]
        limit.write_text(f"{max(kept + mb * 2**20, 2**20)}\n", "ascii")

    @property
    def pid(self) -> int:
        return int(self.show("MainPID"))

    def start(self) -> None:
        sh(f"systemctl start {self.name}")  # returns when it has said READY=1

    def stop(self) -> None:
        sh(f"systemctl stop {self.name}")

    def journal(self) -> str:
        sh("journalctl --sync")
        return sh(f"journalctl -b -o cat -u {self.name}")

    def said(self) -> str:
        """What the daemon itself, not systemd about it, has written into the journal."""
        sh("journalctl --sync")
        return sh(f"journalctl -b -o cat -t taxeld _SYSTEMD_UNIT={self.name}.service")

    def ended_s(self) -> float:
        """Unix time at which its process ended last."""
        sh("journalctl --sync")
        lines = sh(f"journalctl -b -o short-unix -u {self.name} -g 'Main process exited'")
        return float(lines.splitlines()[-1].split()[0])

    def restarts(self) -> int:
        return int(self.show("NRestarts"))

    def wait_restarted(self, restarts: int) -> None:
        """Until systemd has started it once more than `restarts`, and it is ready."""
        until(f"{self.name} is restarted", lambda: self.restarts() > restarts)
        until(f"{self.name} is active", lambda: self.show("ActiveState") == "active")


VCAN0 = Unit("vcan0")
ON_VCAN0 = ("--can", "vcan0")
SESSIONS = Path("/var/lib/taxeld/vcan0/sessions")


def vcan0_is_there() -> None:
    """The interface and the instance, as the first checks leave them."""
    if not Path("/sys/class/net/vcan0").exists():
        sh("ip link add vcan0 type vcan && ip link set vcan0 up")
    VCAN0.config.write_text(CONFIG % "vcan0", encoding="utf-8")
    sh(f"systemctl enable {VCAN0.name}")
    VCAN0.start()


def recording() -> Path:
    """Have the instance record each of its runs (docs/sessions.md); → the session of this one."""
    if "--record" not in VCAN0.show("ExecStart"):
        VCAN0.stop()
        command = f"{COMMAND} run --record {SESSIONS}/${{INVOCATION_ID}} {VCAN0.config}"
        VCAN0.drop_in("ExecStart=", f"ExecStart={command}")
    VCAN0.start()
    return SESSIONS / VCAN0.show("InvocationID")


def frames_of(where: Path) -> list[Frame]:
    """Of the whole records of a session."""
    found: list[Frame] = []
    with contextlib.suppress(SetupError):  # it has not begun
        items = (arrival.item for arrival in session.arrivals(where))
        found += (item for item in items if isinstance(item, Frame))
    return found


def frame_times(where: Path) -> list[float]:
    """Unix time."""
    return [frame.t for frame in frames_of(where)]


class Touch:
    """A virtual robot that touches a box somewhere, from all sides, and the estimates of it."""

    def __init__(self, seed: int, *where: str) -> None:
        """`where` is `--can INTERFACE` or `--link PATH`."""
        for command in ("tare", "reset"):  # another skin, another box
            client.ask(ControlConfig().endpoint, command, timeout_s=PATIENCE_S)
        self._place = tempfile.TemporaryDirectory()
        directory = Path(self._place.name)
        scenario = directory / "touches.toml"
        scenario.write_text(SCENARIO, encoding="utf-8")
        self._skin = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "taxeld_hil.cli",
                "emulate",
                str(scenario),
                "--seed",
                str(seed),
                "--poses",
                POSES,
                "--out",
                str(directory),
                *where,
            ]
        )
        try:
            truth = directory / session.TRUTH
            until("the virtual skin", truth.exists)
            self.truth = session.truth(directory)
        except BaseException:
            self._skin.kill()
            raise
        skin = layouts.load(SkinConfig().layout)
        self._scene = bundle.load("box", skin, SkinConfig().full_scale_depth_m).model.scene
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SUBSCRIBE, topics.ESTIMATE)
        self._socket.connect(PublishConfig().endpoints[0])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._skin.kill()
        self._skin.wait()
        self._context.destroy()
        self._place.cleanup()

    def wait(self, what: str, true: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The first estimate from now on of which `true` holds."""
        last: dict[str, Any] | None = None
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            if not self._socket.poll(1000):
                continue
            last = msgpack.unpackb(self._socket.recv_multipart()[1])
            if true(last):
                return last
        raise AssertionError(f"waited in vain: {what}; last was {self._told(last)}")

    def wait_felt(self) -> None:
        """Until the skin has been learned, and fresh scans are estimated."""
        self.wait("fresh scans", lambda e: e["status"] in (Status.SEARCHING, Status.AMBIGUOUS))

    def wait_found(self) -> str:
        """Until an estimate says that it has converged, and has."""
        found = self.wait(
            "a converged estimate",
            lambda e: e["valid"] and e["status"] == Status.CONVERGED and self.error_mm(e) < GOOD_MM,
        )
        return f"{self.error_mm(found):.1f} mm after contact {found['contacts']}"

    def _told(self, estimate: dict[str, Any] | None) -> str:
        if estimate is None:
            return "nothing"
        status, contacts = Status(estimate["status"]).name.lower(), estimate["contacts"]
        return f"{status}, contacts {contacts}, error {self.error_mm(estimate):.1f} mm"

    def error_mm(self, estimate: dict[str, Any]) -> float:
        pose = estimate["map"]
        at = np.array([pose["x"], pose["y"], pose["theta"]])
        return 1e3 * add_m(self._scene, at, self.truth)[1]
