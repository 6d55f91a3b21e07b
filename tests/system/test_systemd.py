"""The unit and what comes with it, as systemd's own tools judge them."""

import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from types import ModuleType

import pytest

from taxeld import cli, command_line
from taxeld.config.tables import ControlConfig, PublishConfig
from taxeld.door import settings as door
from taxeld.service.doorkeeper import CHANGE_GROUP
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
    found = defaultdict(list)
    for key, value in re.findall(r"^(\w+)=(.*)$", path.read_text(encoding="utf-8"), re.MULTILINE):
        found[key].append(value)
    return found


def analyzed(*arguments: str) -> str:
    """What systemd-analyze prints that has nothing to say against it."""
    command = ["systemd-analyze", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    return done.stdout


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_unit_is_taken_and_exposed_no_more_than_it_must_be(tmp_path: Path, unit: Path) -> None:
    """With a command that exists: the installed one need not be on this machine."""
    most = f"--threshold={round(10 * EXPOSURE)}"
    told = analyzed("security", "--offline=true", "--no-pager", most, str(unit))
    assert float(re.findall(r"Overall exposure level for \S+: ([\d.]+)", told)[0]) <= EXPOSURE
    command = settings(unit)["ExecStart"][0].split()[0]
    copy = tmp_path / unit.name.replace("@", "@can0")
    copy.write_text(unit.read_text("utf-8").replace(command, sys.executable), encoding="utf-8")
    analyzed("verify", "--man=no", str(copy))


(PROPOSED,) = re.findall(r'Environment="TAXELD_ROS2=(.*?)"', BRIDGE.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("unit", "more", "program", "expected"),
    [
        (UNIT, "", cli, {"config": Path("/etc/taxeld/can0.toml")}),
        (BRIDGE, "", bridge, {"daemon": "/etc/taxeld/can0.toml", "sensor_topic": ""}),
        (BRIDGE, PROPOSED, bridge, {"sensor_topic": "/arm/skin"}),
    ],
    ids=["the daemon's", "the bridge's", "the bridge's with the options that it proposes"],
)
def test_a_unit_starts_what_the_command_line_takes(
    unit: Path, more: str, program: ModuleType, expected: dict[str, object]
) -> None:
    (start,) = settings(unit)["ExecStart"]
    command, *arguments = start.replace("%i", "can0").replace("$TAXELD_ROS2", more).split()
    args = program._parser().parse_args(arguments)
    assert Path(command) == Path("/usr/lib/taxeld/bin") / unit.stem.removesuffix("@")
    assert vars(args).items() >= ({"command": program._run} | expected).items()


def test_the_units_hold_what_the_code_has() -> None:
    """Exit statuses, groups, places and limits that stand in both."""
    unit, beside = settings(), settings(BRIDGE)
    usage = str(command_line.USAGE_ERROR)
    for each in (unit, beside):
        assert (each["Restart"], each["RestartPreventExitStatus"]) == (["always"], [usage])
    assert beside["Group"] == unit["Group"], "who may open the daemon's sockets"
    assert not {"Requires", "BindsTo", "PartOf"} & set(beside), "it outlives the daemon"
    assert "TAXELD_ROS2=" in beside["Environment"], "no options, unless somebody says more"
    places = {
        str(Path(endpoint).parent)
        for endpoint in (*PublishConfig().endpoints, ControlConfig().endpoint)
    }
    assert places == {f"ipc:/run/{unit['RuntimeDirectory'][0]}"}
    made = (SYSTEMD / "taxeld.sysusers").read_text(encoding="utf-8")
    assert re.search(rf"^u {unit['User'][0]} (.*\n)*g {CHANGE_GROUP} ", made, re.MULTILINE)
    assert f'GROUP="{unit["Group"][0]}"' in RULES.read_text(encoding="utf-8")
    assert int(unit["LimitNOFILE"][0]) == door.DESCRIPTORS
    bytes_max = int(unit["MemoryMax"][0].removesuffix("G")) << 30
    assert bytes_max > 4 * door.MEMORY_BYTES, "most of it is the loop's"
    assert (unit["OOMPolicy"], unit["KillMode"]) == (["continue"], ["mixed"]), "the door ends alone"
