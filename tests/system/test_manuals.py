"""Manual pages and completions name every command, option and choice, and can be read."""

import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from deploy import manuals

from taxeld import __version__

ROOT = Path(__file__).parents[2]
PROGRAMS = list(manuals.PROGRAMS)


def options(program: str) -> set[str]:
    """Of its commands, or its own where it is one command itself."""
    parser = manuals.parser_of(program)
    commands = manuals.commands_of(parser).values() or [parser]
    found = [a.option_strings for each in commands for a in manuals.arguments_of(each)]
    return {option for strings in found for option in strings}


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_page_has_each_command_and_each_option(program: str) -> None:
    page = manuals.manual(program).replace(r"\-", "-")
    for name in manuals.commands_of(manuals.parser_of(program)):
        assert f".SS {program} {name}\n" in page
    assert options(program) > {"--help", "--version"}
    for option in options(program):
        assert option in page
    assert f'"taxeld {__version__}"' in page
    assert "..." not in page.split(".SH NAME")[1].split(".SH")[0]


@pytest.mark.skipif(not shutil.which("groff"), reason="groff is not installed")
@pytest.mark.parametrize("program", PROGRAMS)
def test_groff_has_nothing_to_say_against_a_page(program: str) -> None:
    done = subprocess.run(
        ["groff", "-man", "-wall", "-Wbreak", "-Kutf8", "-Tutf8", "-z"],
        input=manuals.manual(program), capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stderr == ""


def completed(program: str, *words: str) -> set[str]:
    """What bash offers for the last of these words."""
    function = "_" + program.replace("-", "_")
    typed = " ".join(f"'{word}'" for word in (program, *words))
    script = (
        f"{manuals.bash(program)}\nCOMP_WORDS=({typed}) COMP_CWORD={len(words)}\n{function}\n"
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "--norc", "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    return set(done.stdout.split())


@pytest.mark.parametrize("program", [p for p in PROGRAMS if p != "taxeld-ros2"])
def test_bash_completes_commands_and_options(program: str) -> None:
    commands = manuals.commands_of(manuals.parser_of(program))
    assert completed(program, "") == {*commands, "--help", "--version"}
    for name, command in commands.items():
        strings = {s for a in manuals.arguments_of(command) for s in a.option_strings}
        assert completed(program, name, "--") == {s for s in strings if s.startswith("--")}


def test_bash_completes_the_options_of_a_program_without_commands() -> None:
    long = {option for option in options("taxeld-ros2") if option.startswith("--")}
    assert completed("taxeld-ros2", "--") == long
    assert completed("taxeld-ros2", "can0.toml", "--sensor-t") == {"--sensor-tf", "--sensor-topic"}
    assert completed("taxeld-ros2", "can0") == set()  # bash itself offers files


def test_each_program_that_pip_installs_has_a_page() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    scripts = {name: place.split(":")[0] for name, place in project["scripts"].items()}
    assert scripts == manuals.PROGRAMS


def test_bash_completes_a_choice_after_its_option() -> None:
    assert completed("taxeld", "run", "--log-level", "") == {"debug", "info", "warning", "error"}
    assert completed("taxeld", "decode", "--dialect", "ic") == {"icub"}
    assert completed("taxeld", "ru") == {"run"}
    assert completed("taxeld", "run", "can0") == set()  # bash itself offers files


@pytest.mark.skipif(not shutil.which("zsh"), reason="zsh is not installed")
@pytest.mark.parametrize("program", PROGRAMS)
def test_zsh_can_read_its_completion(program: str, tmp_path: Path) -> None:
    path = tmp_path / f"_{program}"
    path.write_text(manuals.zsh(program), encoding="utf-8")
    subprocess.run(["zsh", "-n", str(path)], check=True)


def test_everything_is_written_where_man_and_shells_look(tmp_path: Path) -> None:
    manuals.write(tmp_path)
    for program in PROGRAMS:
        assert (tmp_path / "share" / "man" / "man1" / f"{program}.1").is_file()
        assert (tmp_path / "share" / "bash-completion" / "completions" / program).is_file()
        assert (tmp_path / "share" / "zsh" / "site-functions" / f"_{program}").is_file()
