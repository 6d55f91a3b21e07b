"""Rules of the whole house."""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections import defaultdict
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
from deploy import manuals

from taxeld import __version__, cli, command_line
from taxeld.command_line import ONE_THREAD
from taxeld.config import file as config_file
from taxeld.config import gate
from taxeld.config.tables import ControlConfig, PublishConfig
from taxeld.door import settings as door
from taxeld.service.doorkeeper import CHANGE_GROUP
from taxeld_hil.scenario.scenario import Scenario, shipped
from taxeld_ros2 import cli as bridge
from taxeld_sim.world.mesh_config import FOAMS
from tests import pages
from tests.rig.processes import python

ROOT = Path(__file__).parents[2]
PACKAGES = ("daemon", "hil", "training", "ros2")
INSTALLED = re.compile(r"pip install|taxeld\[")


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_version_is_the_same_wherever_it_stands() -> None:
    sections = re.findall(
        r"^## (\S+)(?:, \d{4}-\d\d-\d\d)?$", text_of("CHANGELOG.md"), re.MULTILINE
    )
    released = next(each for each in sections if each != "Unreleased")
    assert PROJECT["version"] == __version__ == released


def test_contributing_lists_every_make_target_and_files_that_are_there() -> None:
    text = text_of("CONTRIBUTING.md")
    targets = " ".join(re.findall(r"^\.PHONY: (.*)$", text_of("Makefile"), re.MULTILINE)).split()
    assert {each for each in targets if f"`make {each}`" not in text} == {"clean"}
    named = re.findall(r"`(\w+/[\w/]+\.\w+)`", text)
    parts = (ROOT, *(ROOT / part for part in ("daemon", "training", "hil")))
    assert [each for each in named if not any((part / each).is_file() for part in parts)] == []


def test_what_is_to_be_installed_comes_from_the_clone_or_a_wheel_and_from_no_index() -> None:
    """taxeld is on no index; pip knows the packages of its extras by their own names."""
    texts = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("*.*")]
    texts += [path for room in PACKAGES for path in (ROOT / room).rglob("*.py")]
    lines = (line for path in texts for line in path.read_text(encoding="utf-8").splitlines())
    named = (
        re.findall(r"(\S*)\[[a-z0-9,{}]+\]'", line) for line in lines if INSTALLED.search(line)
    )
    assert {one.strip("`'") for each in named for one in each} <= {".", "WHEEL"}


def test_the_way_of_a_scan_names_methods_that_are_there() -> None:
    _, block, _ = text_of("docs/architecture.md").split("```")
    rooms = (ROOT / "daemon", ROOT / "firmware_protocol")
    files = [path.read_text(encoding="utf-8") for room in rooms for path in room.rglob("*.py")]
    named = re.findall(r"\b([A-Z]\w+)\.(\w+)", block)
    assert len(named) > 10
    for owner, name in named:
        assert any(f"class {owner}" in text and f"def {name}(" in text for text in files), name


def pins(name: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==([^\s\\]+)", text_of(name), re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", package).lower(): version for package, version in found}


def test_the_lock_pins_every_dependency_at_the_version_that_was_tested() -> None:
    locked = pins("requirements.lock")
    assert locked.items() <= pins("constraints.txt").items()
    assert {re.split(r"[<>=~!]", d)[0].lower() for d in PROJECT["dependencies"]} <= locked.keys()
    entry = r"(#.*\n)*[\w.-]+==\S+( \\\n    --hash=sha256:[0-9a-f]{64})+\n?"
    assert re.fullmatch(rf"({entry})+", text_of("requirements.lock"))


@pytest.mark.check
def test_the_benchmark_of_the_service_runs() -> None:
    command = [sys.executable, "benchmarks/service.py", "--seconds", "0.5"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "touched all the time: a core's share" in ran.stdout


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


PROGRAMS = {program: import_module(module) for program, module in manuals.PROGRAMS.items()}
EXTRAS = {  # extra → modules that only it installs
    extra: [
        re.split("[<>=]", need)[0].replace("rerun-sdk", "rerun").replace("-", "_") for need in needs
    ]
    for extra, needs in PROJECT["optional-dependencies"].items()
    if extra != "dev"
}
HEAVY = {  # the slow ones: 0.03 to 2 s of CPU each
    *("numpy", "zmq", "can", "serial", "onnxruntime", "msgpack"),
    *(module for modules in EXTRAS.values() for module in modules),
}
ALL = [
    (program, [name] if name else [], parser)
    for program, module in PROGRAMS.items()
    for top in [module._parser()]
    for name, parser in {"": top, **manuals.commands_of(top)}.items()
]
NAMES = [" ".join([program, *name]) for program, name, _ in ALL]


STARTED = """
import os, sys
from {module} import main
try:
    main(["--help"])
except SystemExit:
    pass
print(*(os.environ[name] for name in {threads}), *sorted(sys.modules), file=sys.stderr)
"""


@pytest.mark.parametrize("given", [{}, {ONE_THREAD[0]: "2"}], ids=["none given", "two"])
@pytest.mark.parametrize("program", PROGRAMS)
def test_help_imports_nothing_that_is_slow_and_numpy_will_have_one_thread_unless_told_otherwise(
    program: str, given: dict[str, str]
) -> None:
    """On a robot's computer other threads fight for the loop's core."""
    environ = {key: value for key, value in os.environ.items() if key not in ONE_THREAD}
    code = STARTED.format(module=PROGRAMS[program].__name__, threads=ONE_THREAD)
    *threads, loaded = python(code, env=environ | given).stderr.split(maxsplit=len(ONE_THREAD))
    assert threads == [given.get(ONE_THREAD[0], "1"), "1", "1"]
    assert {name.split(".")[0] for name in loaded.split()} & (HEAVY | {"argparse"}) == {"argparse"}


@pytest.mark.parametrize(("program", "name", "parser"), ALL, ids=NAMES)
def test_each_command_has_a_sentence_and_examples_that_it_takes(
    program: str, name: list[str], parser: argparse.ArgumentParser
) -> None:
    assert str(parser.description).endswith(".")
    _, *examples = str(parser.epilog).splitlines()
    assert examples
    for example in examples:
        typed = shlex.split(example.partition(">")[0])
        assert typed[: 1 + len(name)] == [program, *name]
        PROGRAMS[program]._parser().parse_args(typed[1:])


def test_help_is_the_same_where_python_keeps_no_docstrings() -> None:
    command = ["-m", "taxeld.cli", "check", "--help"]
    told = [
        subprocess.run([sys.executable, *given, *command], capture_output=True, check=True).stdout
        for given in ([], ["-OO"])
    ]
    assert b"taxeld check can0.toml" in told[0] == told[1]


@pytest.mark.parametrize("typed", ["taxeld replay x --seed -1", "taxeld-hil run demo --seed -1"])
def test_a_seed_below_0_is_refused(typed: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, *arguments = typed.split()
    with pytest.raises(SystemExit, match="2"):
        PROGRAMS[program].main(arguments)
    assert capsys.readouterr().err.endswith("argument --seed: must be 0 or more, not -1\n")


PAGES = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("docs/*.md"))]
TYPED = re.compile(rf"^(?:\$ | {{4}})?((?:{'|'.join(PROGRAMS)}) .*?)(?: +[#>].*)?$", re.MULTILINE)
ON_A_BUS = '[source]\nkind = "can"\nchannel = "can0"\n'


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_show_commands_and_files_that_are_taken(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    parse = partial(gate.parse, Scenario) if page.name == "harness.md" else config_file.parse
    for program, *arguments in map(shlex.split, TYPED.findall(text)):
        PROGRAMS[program]._parser().parse_args(arguments)
    for toml in (block for language, block in pages.FENCED.findall(text) if language == "toml"):
        on_a_bus = "[source]" not in toml and page.name != "harness.md"
        parse(ON_A_BUS * on_a_bus + toml, page.name)


def test_the_harness_lists_its_scenarios_and_foams() -> None:
    text = " ".join(PROGRAMS["taxeld-hil"]._parser().format_help().split())
    listed = f"Scenarios: {', '.join(shipped())}. Foams of the simulated skin: {', '.join(FOAMS)}."
    assert listed in text


WITHOUT_MODULES = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {missing}:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Missing())
from {module} import main
sys.exit(main({typed}))
"""
WITHOUT = [
    ("taxeld-train", ["build", "x.stl", "--out", "{place}/x"], "train"),
    ("taxeld", ["view", "--save", "{place}/x"], "view"),
    ("taxeld", ["calibrate", "{place}", "--out", "{place}/x"], "calibrate"),
    ("taxeld-ros2", ["ipc://{place}/stream"], "ros2"),
]


@pytest.mark.parametrize(("program", "arguments", "extra"), WITHOUT, ids=[w[1][0] for w in WITHOUT])
def test_a_missing_extra_is_one_line_that_names_the_command_that_installs_it(
    tmp_path: Path, program: str, arguments: list[str], extra: str
) -> None:
    typed = [one.format(place=tmp_path) for one in arguments]
    code = WITHOUT_MODULES.format(
        missing=EXTRAS[extra], module=PROGRAMS[program].__name__, typed=typed
    )
    ran = python(code, check=False)
    line = rf".*is not installed: {re.escape(sys.executable)} -m pip install \S.*\n"
    assert (ran.returncode, bool(re.fullmatch(line, ran.stderr))) == (2, True), ran.stderr


FILES = manuals.files()
COMMANDS = manuals.commands_of(PROGRAMS["taxeld"]._parser())


@pytest.mark.skipif(not shutil.which("groff"), reason="groff is not installed")
@pytest.mark.parametrize("program", manuals.PROGRAMS)
def test_groff_has_nothing_to_say_against_a_page(program: str) -> None:
    command = ["groff", "-man", "-wall", "-Wbreak", "-Kutf8", "-Tutf8", "-z"]
    page = FILES[f"share/man/man1/{program}.1"]
    done = subprocess.run(command, input=page, capture_output=True, text=True, check=True)
    assert done.stderr == ""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_page_has_each_command_with_its_options_and_examples(name: str) -> None:
    page, command = FILES["share/man/man1/taxeld.1"].replace(r"\-", "-"), COMMANDS[name]
    options = set(command._option_string_actions) - {"--help"}
    shown = [f".SS \\fBtaxeld {name}\\fR\n{command.description}", *options]
    assert [each for each in (*shown, *str(command.epilog).splitlines()) if each not in page] == []


OFFERED = [(["run", "READ"], {"README.md"}), (["ru"], {"run"}), ([""], set(COMMANDS))]
OFFERED += [([name, "-"], set(made._option_string_actions)) for name, made in COMMANDS.items()]


@pytest.mark.parametrize(
    ("words", "offers"), OFFERED, ids=[" ".join(words) for words, _ in OFFERED]
)
def test_bash_completes_commands_options_choices_and_files(
    words: list[str], offers: set[str]
) -> None:
    typed = " ".join(f"'{word}'" for word in ("taxeld", *words))
    script = (
        f"{FILES['share/bash-completion/completions/taxeld']}\n"
        f"COMP_WORDS=({typed}) COMP_CWORD={len(words)}\n_shtab_taxeld 2>/dev/null\n"
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    command = ["bash", "--norc", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert offers <= set(done.stdout.split())


def test_each_program_that_pip_installs_has_a_page() -> None:
    scripts = {name: place.split(":")[0] for name, place in PROJECT["scripts"].items()}
    assert scripts == manuals.PROGRAMS
