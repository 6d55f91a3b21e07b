"""Manual pages and completions name every command, option and choice, and can be read."""

import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from deploy import manuals

import taxeld.cli

ROOT = Path(__file__).parents[2]
FILES = manuals.files()
COMMANDS = manuals.commands_of(taxeld.cli._parser())


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
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    scripts = {name: place.split(":")[0] for name, place in project["scripts"].items()}
    assert scripts == manuals.PROGRAMS
