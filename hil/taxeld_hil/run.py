"""`taxeld-hil run`: virtual skin and robot, daemon and subscriber, each a process of its own."""

import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from taxeld import session
from taxeld.errors import SetupError
from taxeld_hil.scenario import Scenario

GRACE_S = 5.0
START_S = 15.0

CONFIG = """\
[skin]
layout = "{layout}"
full_scale_counts = {full_scale_counts}
[source]
kind = "can"
interface = "slcan"
channel = "{channel}"
[scene]
bundle = "{bundle}"
[sensor_pose]
endpoint = "{poses}"
[filter]
seed = {seed}
[publish]
endpoints = ["{stream}"]
[control]
endpoint = "{control}"
"""


@dataclass(frozen=True, slots=True)
class Result:
    """How a scenario ended."""

    error_mm: float
    session: Path


def run(name: str, scenario: Scenario, seed: int, directory: Path) -> Result:
    """Run a scenario in real time; the session it leaves is in `directory`.

    Raises:
        SetupError: a process failed; its own message says why.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="taxeld-") as temporary:
        place = Path(temporary)
        stream, poses = f"ipc://{place}/stream", f"ipc://{place}/poses"
        device = place / "skin"
        config = directory / session.CONFIG
        config.write_text(
            CONFIG.format(
                layout=scenario.layout,
                full_scale_counts=scenario.full_scale_counts,
                channel=device,
                bundle=scenario.bundle,
                poses=poses,
                seed=seed,
                stream=stream,
                control=f"ipc://{place}/control",
            ),
            encoding="utf-8",
        )
        daemon: subprocess.Popen[bytes] | None = None
        watch: subprocess.Popen[bytes] | None = None
        skin = _start("taxeld_hil.cli", "emulate", name, "--seed", str(seed), "--link", str(device),
                      "--poses", poses, "--out", str(directory))  # fmt: skip
        try:
            _wait_for(device, skin)
            daemon = _start("taxeld.cli", "run", str(config))
            watch = _start(
                "taxeld_hil.cli",
                "watch",
                "--endpoint",
                stream,
                "--bundle",
                scenario.bundle,
                "--layout",
                scenario.layout,
                "--truth",
                str(directory / session.TRUTH),
                "--error-to",
                str(place / "error"),
            )
            while skin.poll() is None:
                for process, what in ((daemon, "the daemon"), (watch, "the subscriber")):
                    if process.poll() is not None:
                        raise SetupError(f"{what} ended early, with status {process.returncode}")
                time.sleep(0.05)
            if skin.returncode:
                raise SetupError(f"the virtual skin ended with status {skin.returncode}")
            _stop(watch, "the subscriber")
            _stop(daemon, "the daemon")
            return Result(float((place / "error").read_text(encoding="ascii")), directory)
        finally:
            for started in (skin, daemon, watch):
                if started is not None and started.poll() is None:
                    started.kill()
                    started.wait()


def _start(module: str, *args: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", module, *args])  # noqa: S603


def _wait_for(device: Path, skin: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_S
    while not device.exists():
        if skin.poll() is not None or time.monotonic() > deadline:
            raise SetupError("the virtual skin did not start")
        time.sleep(0.02)


def _stop(process: subprocess.Popen[bytes], what: str) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        status = process.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        raise SetupError(f"{what} did not stop within {GRACE_S:g} s") from None
    if status:
        raise SetupError(f"{what} ended with status {status}")
