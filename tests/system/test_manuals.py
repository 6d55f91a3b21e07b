"""Manual pages and completions name every command, option and choice, and can be read."""

import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from deploy import manuals

import taxeld.cli

ROOT = Path(__file__).parents[2]
PROGRAMS = list(manuals.PROGRAMS)
FILES = manuals.files()
COMMANDS = manuals.commands_of(taxeld.cli._parser())


@pytest.mark.parametrize("program", PROGRAMS)
def test_groff_has_nothing_to_say_against_a_page(program: str) -> None:
    if not shutil.which("groff"):
        pytest.skip("groff is not installed")
    done = subprocess.run(
        ["groff", "-man", "-wall", "-Wbreak", "-Kutf8", "-Tutf8", "-z"],
        input=FILES[f"share/man/man1/{program}.1"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""


def test_a_page_has_each_command_with_its_options_and_examples() -> None:
    page = FILES["share/man/man1/taxeld.1"].replace(r"\-", "-")
    for name, command in COMMANDS.items():
        assert f".SS \\fBtaxeld {name}\\fR\n{command.description}" in page
        assert command.epilog is not None
        for line in command.epilog.splitlines():
            assert line in page
        for option in set(command._option_string_actions) - {"--help"}:
            assert option in page


def completed(*words: str) -> set[str]:
    """What bash offers for the last of these words after `taxeld`."""
    typed = " ".join(f"'{word}'" for word in ("taxeld", *words))
    script = (
        f"{FILES['share/bash-completion/completions/taxeld']}\n"
        f"COMP_WORDS=({typed}) COMP_CWORD={len(words)}\n_shtab_taxeld 2>/dev/null\n"
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    command = ["bash", "--norc", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


def test_bash_completes_commands_options_choices_and_files() -> None:
    assert set(COMMANDS) <= completed("")
    for name, command in COMMANDS.items():
        assert set(command._option_string_actions) <= completed(name, "-")
    assert completed("ru") == {"run"}
    assert completed("run", "READ") == {"README.md"}


def test_each_program_that_pip_installs_has_a_page() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    scripts = {name: place.split(":")[0] for name, place in project["scripts"].items()}
    assert scripts == manuals.PROGRAMS
