"""The unit and what comes with it, as systemd's own tools judge them."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from taxeld import cli
from taxeld.config import ControlConfig, PublishConfig

ROOT = Path(__file__).parents[2]
SYSTEMD = ROOT / "systemd"
UNIT = SYSTEMD / "taxeld@.service"
EXPOSURE = 1.6

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)


def settings(path: Path = UNIT) -> dict[str, list[str]]:
    """Every assignment of a unit file, in order."""
    found: dict[str, list[str]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if match := re.fullmatch(r"(\w+)=(.*)", line):
            found.setdefault(match[1], []).append(match[2])
    return found


@needs_systemd
def test_the_unit_is_exposed_no_more_than_it_must_be() -> None:
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager",
         f"--threshold={round(10 * EXPOSURE)}", str(UNIT)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == ""
    last = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert last is not None
    assert float(last[1]) <= EXPOSURE


@needs_systemd
def test_systemd_has_nothing_to_say_against_the_unit(tmp_path: Path) -> None:
    """With a command that exists: the installed one need not be on this machine."""
    text = UNIT.read_text(encoding="utf-8")
    command = settings()["ExecStart"][0].split()[0]
    copy = tmp_path / UNIT.name
    copy.write_text(text.replace(command, sys.executable), encoding="utf-8")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(tmp_path / "taxeld@can0.service")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stderr == ""
    assert done.returncode == 0


def test_the_unit_starts_what_the_command_line_takes() -> None:
    (start,) = settings()["ExecStart"]
    command, *arguments = start.replace("%i", "can0").split()
    assert command == "/usr/local/lib/taxeld/bin/taxeld"
    args = cli._parser().parse_args(arguments)
    assert args.config == Path("/etc/taxeld/can0.toml")
    assert args.command is cli._run


def test_what_exits_as_a_configuration_fault_is_not_started_again() -> None:
    unit = settings()
    assert unit["RestartPreventExitStatus"] == [str(cli.USAGE_ERROR)]
    assert unit["Restart"] == ["always"]
    assert unit["StartLimitIntervalSec"] == ["0"]


def test_the_default_endpoints_lie_in_the_units_runtime_directory() -> None:
    (directory,) = settings()["RuntimeDirectory"]
    endpoints = [*PublishConfig().endpoints, ControlConfig().endpoint]
    for endpoint in endpoints:
        assert endpoint.startswith((f"ipc:///run/{directory}/", "tcp://127.0.0.1:"))


def test_the_daemons_user_is_made_and_owns_its_lines() -> None:
    unit = settings()
    made = (SYSTEMD / "taxeld.sysusers").read_text(encoding="utf-8")
    assert re.search(rf"^u {unit['User'][0]} ", made, re.MULTILINE)
    rules = (SYSTEMD / "60-taxeld.rules").read_text(encoding="utf-8")
    assert f'GROUP="{unit["Group"][0]}"' in rules
    majors = {"char-166 rw": "ttyACM", "char-188 rw": "ttyUSB"}
    assert unit["DeviceAllow"] == list(majors)
    assert all(name in rules for name in majors.values())


def test_install_puts_files_where_systemd_looks_and_uninstall_takes_exactly_them(
    tmp_path: Path,
) -> None:
    """What `make` would run, with the environment left out: the virtual machine installs that."""
    alone = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}  # of `make test`

    def make(target: str) -> None:
        prefix = ["PREFIX=/opt/skin", f"DESTDIR={tmp_path}"]
        done = subprocess.run(
            ["make", "-n", target, *prefix],
            cwd=ROOT, env=alone, capture_output=True, text=True, check=True,
        )  # fmt: skip
        lines = done.stdout.replace("\\\n", " ").splitlines()
        kept = [line for line in lines if not re.search(r"-m (venv|pip) |bin/taxeld\*$", line)]
        subprocess.run("\n".join(kept), shell=True, cwd=ROOT, check=True)

    make("install")
    put = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if not p.is_dir()}
    assert put == {
        "opt/skin/bin/taxeld", "opt/skin/lib/systemd/system/taxeld@.service",
        "opt/skin/lib/systemd/network/60-can0.network", "opt/skin/lib/sysusers.d/taxeld.conf",
        "opt/skin/lib/udev/rules.d/60-taxeld.rules", "opt/skin/share/doc/taxeld/can0.toml",
        "opt/skin/share/doc/taxeld/service.md",
    }  # fmt: skip
    unit = settings(tmp_path / "opt/skin/lib/systemd/system/taxeld@.service")
    assert unit["ExecStart"] == ["/opt/skin/lib/taxeld/bin/taxeld run /etc/taxeld/%i.toml"]
    make("uninstall")
    assert not [p for p in tmp_path.rglob("*") if not p.is_dir()]


def test_the_documentation_names_every_check_of_the_virtual_machine() -> None:
    guest = (ROOT / "tests" / "vm" / "guest.py").read_text(encoding="utf-8")
    checks = re.findall(r"^@check\ndef (\w+)", guest, re.MULTILINE)
    text = " ".join((ROOT / "docs" / "service.md").read_text(encoding="utf-8").split())
    assert len(checks) > 10
    assert [name for name in checks if name.replace("_", " ") not in text] == []
