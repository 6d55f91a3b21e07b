"""`make bench-aarch64`: whether the service installs and works on an aarch64 processor, on one that
QEMU emulates. Its time is not judged: that of an emulated processor tells nothing.

Debian's Python for aarch64, the wheels of requirements.lock and taxeld's own are put into a
directory of this machine's, where `qemu-aarch64` runs them as programs of it; the part in C is
compiled where a cross compiler is at hand. Then a session is replayed on both processors, and a
daemon that replays it in real time is listened to from outside. Needs Debian packages, no root.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgpack
import numpy as np
import zmq

from taxeld.stream import client, messages

ROOT = Path(__file__).parents[1]
NEEDS = {"qemu-aarch64": "qemu-user", "apt-get": "apt", "dpkg-deb": "dpkg"}
SUITE, PYTHON = "bookworm", "3.11"
DEBIAN = (f"python{PYTHON}", "libstdc++6", "libgomp1")
MANYLINUX = ("2_28", "2_27", "2_17", "2014")
COMPILER = "aarch64-linux-gnu-gcc"  # of gcc-aarch64-linux-gnu and libc6-dev-arm64-cross
SESSION = ROOT / "tests/daemon/session"  # four contacts of a mug
MODE_MM, SAME = 10.0, 0.95  # both processors believe in the same places, as they round differently
READY_S, HEARD_S, EARLIEST = 600.0, 8.0, 50  # estimates in so many seconds, at least
CPU = "cortex-a72"  # of a Raspberry Pi 4
CPUINFO = """processor\t: {number}
BogoMIPS\t: 108.00
Features\t: fp asimd evtstrm crc32 cpuid
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x0
CPU part\t: 0xd08
CPU revision\t: 3

"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", type=Path, help="where to put it, and leave it")
    args = parser.parse_args()
    missing = [package for need, package in NEEDS.items() if shutil.which(need) is None]
    if missing:
        print(f"make bench-aarch64: missing here: {' '.join(missing)}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="taxeld-aarch64-") as name:
        place = args.keep or Path(name)
        machine = Machine(place)
        if not machine.is_made:
            machine.make()
        return 0 if all([works(machine, place), replays(machine), runs(machine)]) else 1


class Machine:
    """The other processor's programs."""

    def __init__(self, place: Path) -> None:
        self.root, self.site = place / "root", place / "site"
        self._place = place

    @property
    def is_made(self) -> bool:
        return (self.site / "taxeld").is_dir()

    def make(self) -> None:
        say(f"Debian {SUITE}'s Python {PYTHON} for aarch64")
        self._python()
        say("the wheels of requirements.lock for it, by their hashes")
        platforms = [f"--platform=manylinux{'_' * ('_' in m)}{m}_aarch64" for m in MANYLINUX]
        run(
            [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--require-hashes",
             "--only-binary=:all:", f"--target={self.site}", "--implementation=cp",
             f"--python-version={PYTHON}", *platforms, "-r", str(ROOT / "requirements.lock")]
        )  # fmt: skip
        has_compiler = shutil.which(COMPILER) is not None
        say(f"taxeld's own, {'with' if has_compiler else 'without'} the part in C")
        copy = self._place / "source"
        for part in ("firmware_protocol", "daemon", "training", "hil", "ros2"):
            ignored = shutil.ignore_patterns("*.so", "__pycache__")
            shutil.copytree(ROOT / part, copy / part, ignore=ignored)
        for part in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
            shutil.copy(ROOT / part, copy)
        run(
            [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps",
             f"--wheel-dir={self._place}", str(copy)],
            env=os.environ | {"CC": COMPILER},
        )  # fmt: skip
        (wheel,) = self._place.glob("taxeld-*.whl")
        # unpacked, as its name is of the processor that it was built on
        run([sys.executable, "-m", "zipfile", "-e", str(wheel), str(self.site)])

    def command(self, *arguments: str) -> list[str]:
        """A Python of that processor with these arguments."""
        python = self.root / f"usr/bin/python{PYTHON}"
        return ["qemu-aarch64", "-cpu", CPU, "-L", str(self.root), str(python), *arguments]

    @property
    def environment(self) -> dict[str, str]:
        return os.environ | {"PYTHONPATH": str(self.site), "OPENBLAS_NUM_THREADS": "1"}

    def _python(self) -> None:
        """By apt with directories of its own, so that it changes nothing here."""
        apt = self._place / "apt"
        for directory in ("state/lists/partial", "cache/archives/partial"):
            (apt / directory).mkdir(parents=True)
        (apt / "status").touch()
        mirror = run(
            ["apt-get", "indextargets", "--format", "$(REPO_URI)", "Origin: Debian",
             "Label: Debian"]
        ).partition("\n")[0]  # fmt: skip
        keys = "/usr/share/keyrings/debian-archive-keyring.gpg"
        line = f"deb [signed-by={keys}] {mirror} {SUITE} main\n"
        (apt / "sources.list").write_text(line, encoding="ascii")
        options = {
            "APT::Architecture": "arm64", "APT::Architectures": "arm64",
            "Dir::State": f"{apt}/state", "Dir::State::status": f"{apt}/status",
            "Dir::Cache": f"{apt}/cache", "Dir::Etc::sourcelist": f"{apt}/sources.list",
            "Dir::Etc::sourceparts": "/nonexistent", "APT::Sandbox::User": "",
        }  # fmt: skip
        told = [f"-o{key}={value}" for key, value in options.items()]
        run(["apt-get", "-qq", *told, "update"])
        run(
            ["apt-get", "-qq", *told, "-y", "--no-install-recommends", "--download-only",
             "install", *DEBIAN]
        )  # fmt: skip
        for package in (apt / "cache/archives").glob("*.deb"):
            run(["dpkg-deb", "-x", str(package), str(self.root)])
        # else onnxruntime finds this machine's, and ends
        (self.root / "proc").mkdir()
        described = "".join(CPUINFO.format(number=k) for k in range(os.cpu_count() or 1))
        (self.root / "proc/cpuinfo").write_text(described, encoding="ascii")


def works(machine: Machine, place: Path) -> bool:
    """Whether a configuration is checked there, the part in C found, and samples drawn."""
    settings = place / "check.toml"
    settings.write_text(
        '[source]\nkind = "can"\ninterface = "virtual"\nchannel = "check"\n'
        f'[scene]\nbundle = "box"\n[publish]\nendpoints = ["ipc://{place}/stream"]\n'
        f'[control]\nendpoint = "ipc://{place}/control"\n',
        encoding="utf-8",
    )
    told = run(machine.command("-m", "taxeld.cli", "check", str(settings)), env=machine.environment)
    say(f"taxeld check: {told.strip().splitlines()[-1]}")
    code = (
        "import platform, onnxruntime, numpy; from taxeld import native; "
        "print(platform.machine(), 'Python', platform.python_version(), 'numpy', "
        "numpy.__version__, 'onnxruntime', onnxruntime.__version__, "
        "'C' if native.library('estimator/explain') else 'no C')"
    )
    told = run(machine.command("-c", code), env=machine.environment)
    say(told.strip())
    return told.startswith("aarch64")


def replays(machine: Machine) -> bool:
    """Whether a session leads to the same beliefs on both processors."""
    arguments = ("-m", "taxeld.cli", "replay", str(SESSION))
    here = estimates(run([sys.executable, *arguments]))
    there = estimates(run(machine.command(*arguments), env=machine.environment))
    same = np.mean([a["status"] == b["status"] for a, b in zip(here, there, strict=True)])
    last, map_ = here[-1], there[-1]["map"]
    apart_mm = min(
        1e3 * float(np.hypot(mode["x"] - map_["x"], mode["y"] - map_["y"]))
        for mode in last["modes"]
    )
    say(
        f"taxeld replay: {len(there)} estimates, {same:.0%} of the status that they have on this "
        f"processor; the last is {apart_mm:.1f} mm from one of its modes here"
    )
    has_contacts = last["contacts"] == there[-1]["contacts"] > 0
    return bool(has_contacts and same >= SAME and apart_mm <= MODE_MM)


def runs(machine: Machine) -> bool:
    """Whether a daemon there serves its streams and answers."""
    with tempfile.TemporaryDirectory() as name, zmq.Context() as context:
        settings = Path(name) / "run.toml"
        text = (SESSION / "config.toml").read_text(encoding="utf-8")
        head, _, rest = text.partition("[source]")
        scene = rest[rest.index("[scene]") :].partition("[sensor_pose]")[0]
        settings.write_text(
            f'{head}[source]\nkind = "replay"\npath = "{SESSION}"\n{scene}'
            f'[publish]\nendpoints = ["ipc://{name}/stream"]\n'
            f'[control]\nendpoint = "ipc://{name}/control"\n',
            encoding="utf-8",
        )
        with context.socket(zmq.SUB) as stream, _daemon(machine, settings):
            stream.linger = 0
            stream.subscribe(messages.ESTIMATE)
            stream.connect(f"ipc://{name}/stream")
            if not stream.poll(round(1e3 * READY_S)):
                say("taxeld run: it says nothing")
                return False
            answer = client.ask(f"ipc://{name}/control", "status", timeout_s=READY_S)
            until, heard = time.monotonic() + HEARD_S, []
            while (left_s := until - time.monotonic()) > 0.0 and stream.poll(round(1e3 * left_s)):
                heard.append(msgpack.unpackb(stream.recv_multipart()[1]))
    last = heard[-1]
    say(
        f"taxeld run: {len(heard)} estimates in {HEARD_S:g} s, {last['contacts']} contacts, status "
        f"{last['status']}; control {'answers' if answer else 'does not answer'}"
    )
    return len(heard) >= EARLIEST and answer is not None


@contextmanager
def _daemon(machine: Machine, settings: Path) -> Iterator[None]:
    command = machine.command("-m", "taxeld.cli", "run", str(settings))
    process = subprocess.Popen(command, env=machine.environment)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def estimates(text: str) -> list[dict]:
    return [json.loads(line) for line in text.splitlines()]


def run(command: list[str], env: dict[str, str] | None = None) -> str:
    """Its output; what goes wrong ends all."""
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True, env=env)
    if done.returncode:
        raise SystemExit(f"make bench-aarch64: {command[0]} failed ({done.returncode}): "
                         f"{' '.join(command[1:])[:300]}")  # fmt: skip
    return done.stdout


def say(line: str) -> None:
    print(f"aarch64: {line}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
