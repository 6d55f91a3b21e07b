"""The unit and what comes with it, as systemd's own tools judge them."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from taxeld import cli, command_line
from taxeld.config.tables import ControlConfig, PublishConfig
from taxeld.door import sandbox as door
from taxeld_ros2 import cli as bridge

ROOT = Path(__file__).parents[2]
SYSTEMD = ROOT / "systemd"
UNIT = SYSTEMD / "taxeld@.service"
BRIDGE = SYSTEMD / "taxeld-ros2@.service"
UNITS = [UNIT, BRIDGE]
RULES = SYSTEMD / "examples" / "60-taxeld.rules"
EXPOSURE = 1.7

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
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_unit_is_exposed_no_more_than_it_must_be(unit: Path) -> None:
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager",
         f"--threshold={round(10 * EXPOSURE)}", str(unit)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == ""
    last = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert last is not None
    assert float(last[1]) <= EXPOSURE


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_systemd_has_nothing_to_say_against_the_unit(tmp_path: Path, unit: Path) -> None:
    """With a command that exists: the installed one need not be on this machine."""
    text = unit.read_text(encoding="utf-8")
    command = settings(unit)["ExecStart"][0].split()[0]
    copy = tmp_path / unit.name
    copy.write_text(text.replace(command, sys.executable), encoding="utf-8")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(tmp_path / unit.name.replace("@", "@can0"))],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stderr == ""
    assert done.returncode == 0


def test_the_unit_starts_what_the_command_line_takes() -> None:
    (start,) = settings()["ExecStart"]
    command, *arguments = start.replace("%i", "can0").split()
    assert command == "/usr/local/lib/taxeld/current/bin/taxeld"
    args = cli._parser().parse_args(arguments)
    assert args.config == Path("/etc/taxeld/can0.toml")
    assert args.command is cli._run


def test_the_unit_of_the_bridge_and_the_options_it_proposes_start_what_its_command_line_takes() -> (
    None
):
    (start,) = settings(BRIDGE)["ExecStart"]
    said = BRIDGE.read_text(encoding="utf-8")
    assert "TAXELD_ROS2=" in settings(BRIDGE)["Environment"], "none, unless somebody says more"
    (proposed,) = re.findall(r'Environment="TAXELD_ROS2=(.*?)"', said)
    for more in ("", proposed):
        started = start.replace("%i", "can0").replace("$TAXELD_ROS2", more)
        command, *arguments = started.split()
        assert command == "/usr/local/lib/taxeld/current/bin/taxeld-ros2"
        args = bridge._parser().parse_args(arguments)
        assert args.config == Path("/etc/taxeld/can0.toml")
        assert args.command is bridge._run
        assert args.sensor_tf == (["world", "skin_link"] if more else None)


def test_the_page_on_the_bridge_installs_the_version_that_it_was_tried_with() -> None:
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    (line,) = re.findall(r"^cyclonedds==.*$", pinned, re.MULTILINE)
    assert f"-m pip install {line}\n" in (ROOT / "docs" / "ros2.md").read_text(encoding="utf-8")


def test_what_peers_may_take_of_the_machine_beside_the_daemon_is_bounded() -> None:
    beside, daemon = settings(BRIDGE), settings(UNIT)
    assert beside["Restart"] == ["always"]
    for limit in ("LimitNOFILE", "MemoryMax", "TasksMax"):
        (value,) = beside[limit]
        assert int(value.removesuffix("M")) > 0
    (after,) = beside["After"]
    assert "taxeld@%i.service" in after
    assert beside["Group"] == daemon["Group"], "who may open the daemon's sockets"
    assert not {"Requires", "BindsTo", "PartOf"} & set(beside), "it outlives the daemon"
    assert beside["RestartPreventExitStatus"] == [str(command_line.USAGE_ERROR)]


def test_what_exits_as_a_configuration_fault_is_not_started_again() -> None:
    unit = settings()
    assert unit["RestartPreventExitStatus"] == [str(command_line.USAGE_ERROR)]
    assert unit["Restart"] == ["always"]


def test_a_fault_at_each_start_ends_and_one_now_and_then_does_not() -> None:
    """Ten starts within five minutes are what a watchdog at its quickest does not reach."""
    unit = settings()
    assert (unit["StartLimitIntervalSec"], unit["StartLimitBurst"]) == (["5min"], ["10"])
    least_s = float(unit["RestartSec"][0]) * int(unit["StartLimitBurst"][0])
    assert least_s < 300.0


def test_nothing_of_the_machines_can_be_used_up() -> None:
    unit = settings()
    assert int(unit["LimitNOFILE"][0]) == door.DESCRIPTORS
    assert {"MemoryMax", "MemorySwapMax", "TasksMax", "LimitRTTIME", "OOMScoreAdjust"} <= set(unit)
    (reload,) = unit["ExecReload"]
    assert reload == "/bin/kill -HUP $MAINPID"


def test_the_door_may_end_alone_and_confine_itself_and_tell_users_apart() -> None:
    unit = settings()
    assert unit["OOMPolicy"] == ["continue"]
    assert unit["KillMode"] == ["mixed"]
    assert "PrivateUsers" not in unit
    *_, own, sandbox = unit["SystemCallFilter"]
    assert {"setrlimit", "sched_setscheduler"} <= set(own.split())
    assert len(re.findall(r"\blandlock_\w+", sandbox)) == 3
    bytes_max = int(unit["MemoryMax"][0].removesuffix("G")) << 30
    assert bytes_max > 4 * door.MEMORY_BYTES, "most of it is the loop's"


def test_there_is_a_group_to_hear_and_one_to_change() -> None:
    unit = settings()
    made = (SYSTEMD / "taxeld.sysusers").read_text(encoding="utf-8")
    assert re.search(rf"^u {unit['User'][0]} ", made, re.MULTILINE)
    assert re.search(rf"^g {ControlConfig().group} ", made, re.MULTILINE)


def test_modem_manager_keeps_away_from_the_daemons_lines() -> None:
    rules = RULES.read_text(encoding="utf-8")
    assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in rules
    assert 'ENV{ID_MM_PORT_IGNORE}="1"' in rules
    assert rules.index("ID_MM_DEVICE_IGNORE") > rules.index('GOTO="taxeld_end"')


def test_the_default_endpoints_lie_in_the_units_runtime_directory() -> None:
    (directory,) = settings()["RuntimeDirectory"]
    endpoints = [*PublishConfig().endpoints, ControlConfig().endpoint]
    for endpoint in endpoints:
        assert endpoint.startswith(f"ipc:///run/{directory}/")


def test_the_rule_gives_the_daemon_its_lines() -> None:
    unit = settings()
    rules = RULES.read_text(encoding="utf-8")
    assert f'GROUP="{unit["Group"][0]}"' in rules
    majors = {"char-166 rw": "ttyACM", "char-188 rw": "ttyUSB"}
    assert unit["DeviceAllow"] == list(majors)
    assert all(name in rules for name in majors.values())
