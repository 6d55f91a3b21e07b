"""A serial line is one process's alone, and who comes second is told whose."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from taxeld import cli
from taxeld.config.tables import SkinConfig, SourceConfig
from taxeld.layout import read as layouts
from taxeld.source import holders
from taxeld.source.device import BusyError
from taxeld.source.sources import LiveSource, open_source
from taxeld_hil import cli as hil_cli
from taxeld_hil.rig.ports import SlcanPort

SKIN = layouts.load(SkinConfig().layout)
DEADLINE_S = 30.0
HOLD = "import fcntl, os, sys, termios, time; fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); "
SERIAL = 'kind = "serial"\nchannel = "{device}"'
SLCAN = 'kind = "can"\ninterface = "slcan"\nchannel = "{device}@115200"'


@pytest.fixture
def port(tmp_path: Path) -> Iterator[SlcanPort]:
    made = SlcanPort(tmp_path / "adapter", lambda _: None)
    yield made
    made.close()


@pytest.fixture
def device(port: SlcanPort, tmp_path: Path) -> str:
    assert port.slave
    return str(tmp_path / "adapter")


def configuration(place: Path, source: str, device: str) -> Path:
    path = place / "config.toml"
    table = source.format(device=device)
    path.write_text(f'[source]\n{table}\n[scene]\nbundle = "box"\n', encoding="utf-8")
    return path


class Holder:
    """Another process that has the line."""

    def __init__(self, *command: str) -> None:
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        self.pid = self._process.pid

    def until_it_has(self, device: str) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not holders.holder(device).startswith(f"pid {self.pid}"):
            assert self._process.poll() is None, self._process.stderr
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
        self._process.communicate(timeout=DEADLINE_S)


@pytest.fixture(params=[SERIAL, SLCAN], ids=["line", "adapter"])
def recording(
    request: pytest.FixtureRequest, device: str, tmp_path: Path
) -> Iterator[tuple[Holder, Path]]:
    """`taxeld record`, which has the line, and a configuration of the same."""
    config = configuration(tmp_path, request.param, device)
    out = str(tmp_path / "first")
    made = Holder(sys.executable, "-m", "taxeld.cli", "record", "--out", out, str(config))
    made.until_it_has(device)
    yield made, config
    made.end()


def test_each_command_that_comes_second_ends_with_one_line_that_names_the_first(
    recording: tuple[Holder, Path], device: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A daemon waits instead, and takes the line once it is free."""
    first, config = recording
    by = f"another process has it open: pid {first.pid}, "
    assert cli.main(["record", "--out", str(tmp_path / "second"), str(config)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"source.channel: cannot open {device} ({by}")
    assert line.endswith("; stop that first)")
    for kind in ("serial", "slcan"):
        target = f"{kind}:{device}"
        layout = SkinConfig().layout
        out = str(tmp_path / "report")
        assert hil_cli.main(["accept", target, "--layout", layout, "--out", out]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"TARGET {target}: cannot open {device} ({by}")
        assert line.endswith("; stop that first)")
        assert not Path(out).exists()
    config_of = SourceConfig(kind="can", interface="slcan", channel=device)
    source = open_source(config_of, SKIN, wait=True)
    assert isinstance(source, LiveSource)
    assert by in source.waits_for
    first.end()
    source.poll(time.monotonic() + 10.0)
    assert source.waits_for == ""
    source.close()


def test_a_line_that_a_program_without_a_lock_holds_as_its_own_is_not_opened(device: str) -> None:
    """To root the kernel would give it all the same."""
    script = HOLD + "fcntl.ioctl(fd, termios.TIOCEXCL); print(1, flush=True); time.sleep(60)"
    other = Holder(sys.executable, "-c", script, device)
    other.until_it_has(device)
    with pytest.raises(BusyError, match=f"open: pid {other.pid}, python"):
        open_source(SourceConfig(kind="serial", channel=device), SKIN)
    other.end()


def test_the_kernel_keeps_other_users_out_of_a_line_that_is_open(device: str) -> None:
    """Who asks for no lock: a terminal program, or a shell that writes to the device."""
    Path(device).chmod(0o666)
    source = open_source(SourceConfig(kind="serial", channel=device), SKIN)
    real = os.path.realpath(device)  # the test's own directory is not open to everybody
    error = written(real)
    assert "busy" in error.lower(), error
    source.close()
    assert written(real) == ""


def written(device: str) -> str:
    """What a shell says that writes to a device; root, whom nothing stops, as nobody."""
    nobody = {"user": 65534, "group": 65534, "extra_groups": ()} if os.geteuid() == 0 else {}
    command = ["/bin/sh", "-c", f"printf C >{device}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, **nobody)  # type: ignore[call-overload]
    return str(done.stderr)


def test_a_line_of_which_the_holder_died_can_be_opened_though_something_keeps_it_open(
    port: SlcanPort, device: str
) -> None:
    """As the harness's adapters are kept open: the kernel then forgets nothing by itself."""
    script = HOLD + (
        "fcntl.flock(fd, fcntl.LOCK_EX); fcntl.ioctl(fd, termios.TIOCEXCL); time.sleep(60)"
    )
    other = Holder(sys.executable, "-c", script, device)
    other.until_it_has(device)
    os.kill(other.pid, 9)
    other.end()
    port.take(0.0)
    source = open_source(SourceConfig(kind="serial", channel=device), SKIN)
    source.close()


def test_whose_a_device_is_that_nobody_has_is_left_out(tmp_path: Path) -> None:
    assert holders.holder(str(tmp_path / "nothing")) == ""
    assert holders.holder("can0") == ""
