"""Manual pages and shell completions of the commands, from their own argument parsers.

`python deploy/manuals.py PREFIX` writes them below PREFIX/share, of the taxeld that this Python has
installed; nothing of them is kept in the repository, so none can be out of date.
"""

import argparse
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from taxeld import __version__

PROGRAMS = {
    "taxeld": "taxeld.cli",
    "taxeld-train": "taxeld_training.cli",
    "taxeld-hil": "taxeld_hil.cli",
    "taxeld-ros2": "taxeld_ros2.cli",
}
STATUS = "0: fine. 1: failed at work. 2: wrong arguments or configuration."
Action = argparse.Action


def parser_of(program: str) -> argparse.ArgumentParser:
    made = import_module(PROGRAMS[program])._parser()
    assert isinstance(made, argparse.ArgumentParser)  # noqa: S101
    return made


def commands_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands of a program, by name; none where it is one command itself."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def arguments_of(parser: argparse.ArgumentParser) -> list[Action]:
    return [a for a in parser._actions if not isinstance(a, argparse._SubParsersAction)]


def manual(program: str) -> str:
    """Its page for man(1), section 1."""
    parser = parser_of(program)
    commands = commands_of(parser)
    synopsis = [r".I COMMAND", ".RI [ ARGUMENTS ]"] if commands else [_roff(_usage(parser))]
    lines = [
        f'.TH {_roff(program.upper())} 1 "" "taxeld {__version__}" "taxeld"',
        ".SH NAME", _roff(f"{program} - {_sentence(parser)}"),
        ".SH SYNOPSIS", rf".B {_roff(program)}", *synopsis,
        ".SH DESCRIPTION", _roff(parser.description or ""),
        *_examples(parser), ".SH COMMANDS" if commands else ".SH OPTIONS",
    ]  # fmt: skip
    for name, command in commands.items():
        lines += [f".SS {_roff(f'{program} {name}')}", _roff(command.description or "")]
        lines += [*_arguments(command), *_examples(command)]
    if not commands:
        lines += _arguments(parser)
    lines += [".SH EXIT STATUS", STATUS, ".SH SEE ALSO"]
    lines += [_roff(", ".join(f"{other}(1)" for other in PROGRAMS if other != program))]
    return "\n".join(lines) + "\n"


def bash(program: str) -> str:
    """Its completion for bash: commands, options and their choices; else files."""
    parser = parser_of(program)
    commands = commands_of(parser)
    function = "_" + program.replace("-", "_")
    if not commands:
        words = " ".join(_words(parser))
        return (
            f"{function}() {{\n    local word=${{COMP_WORDS[COMP_CWORD]}}\n"
            f'    COMPREPLY=($(compgen -W "{words}" -- "$word"))\n}}\n'
            f"complete -o default -F {function} {program}\n"
        )
    lines = [
        f"{function}() {{",
        "    local word=${COMP_WORDS[COMP_CWORD]} last=${COMP_WORDS[COMP_CWORD-1]} words=",
        "    ((COMP_CWORD > 1)) || last=",
        "    case ${COMP_WORDS[1]}:$last in",
    ]
    for name, command in commands.items():
        for action in arguments_of(command):
            if action.choices and action.option_strings:
                patterns = "|".join(f"{name}:{option}" for option in action.option_strings)
                lines.append(f'    {patterns}) words="{" ".join(map(str, action.choices))}" ;;')
    lines += ["    *)", "        case $((COMP_CWORD > 1)):${COMP_WORDS[1]} in"]
    lines.append(f'        0:*) words="{" ".join(commands)} --help --version" ;;')
    for name, command in commands.items():
        lines.append(f'        1:{name}) words="{" ".join(_words(command))}" ;;')
    lines += [
        "        esac ;;", "    esac", '    COMPREPLY=($(compgen -W "$words" -- "$word"))', "}",
        f"complete -o default -F {function} {program}",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def zsh(program: str) -> str:
    """The same for zsh, with what each command and option does."""
    parser = parser_of(program)
    commands = commands_of(parser)
    if not commands:
        return f"#compdef {program}\n_arguments {_specs(parser)} '*: :_files'\n"
    lines = [f"#compdef {program}", "local -a commands=("]
    lines += [f"    {_quoted(name + ':' + _sentence(each))}" for name, each in commands.items()]
    lines += [")", "if ((CURRENT == 2)); then", "    _describe command commands", "    return"]
    lines += ["fi", "local command=$words[2]", "shift words", "((CURRENT--))", "case $command in"]
    for name, command in commands.items():
        lines.append(f"{name}) _arguments {_specs(command)} '*: :_files' ;;")
    return "\n".join([*lines, "esac"]) + "\n"


def write(prefix: Path) -> None:
    """Everything, where man, bash and zsh look for it."""
    for program in PROGRAMS:
        for folder, name, text in (
            ("man/man1", f"{program}.1", manual(program)),
            ("bash-completion/completions", program, bash(program)),
            ("zsh/site-functions", f"_{program}", zsh(program)),
        ):
            place = prefix / "share" / folder
            place.mkdir(parents=True, exist_ok=True)
            (place / name).write_text(text, encoding="utf-8")


def _sentence(parser: argparse.ArgumentParser) -> str:
    return (parser.description or "").partition(". ")[0].partition("; ")[0].rstrip(".")


def _usage(parser: argparse.ArgumentParser) -> str:
    """The arguments of a program that is one command, in a line."""
    return " ".join(parser.format_usage().split()[2:])


def _arguments(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in arguments_of(parser):
        yield from (".TP", f".B {_roff(_head(parser, action))}", _roff(_text(parser, action)))


def _specs(parser: argparse.ArgumentParser) -> str:
    """Its options, as zsh's _arguments has them."""
    return " ".join(
        _quoted(f"{option}[{_zsh(_text(parser, action))}]{_value(action)}")
        for action in arguments_of(parser)
        for option in action.option_strings
    )


def _head(parser: argparse.ArgumentParser, action: Action) -> str:
    """An argument as it is typed."""
    shown = parser.formatter_class(prog="")
    return shown._format_action_invocation(action)


def _text(parser: argparse.ArgumentParser, action: Action) -> str:
    return parser.formatter_class(prog="")._expand_help(action) if action.help else ""


def _examples(parser: argparse.ArgumentParser) -> Iterator[str]:
    title, *examples = (parser.epilog or "").splitlines()
    if examples:
        yield from (".P", title, ".nf", ".RS", *(_roff(line.strip()) for line in examples))
        yield from (".RE", ".fi")


def _words(command: argparse.ArgumentParser) -> list[str]:
    """What can be typed in a command, but for names of files."""
    words: list[str] = []
    for action in arguments_of(command):
        words += action.option_strings or map(str, action.choices or ())
    return words


def _value(action: Action) -> str:
    if action.nargs == 0:
        return ""
    if action.choices:
        return f":value:({' '.join(map(str, action.choices))})"
    return ":value:_files"


def _zsh(text: str) -> str:
    return re.sub(r"([\[\]:\\])", r"\\\1", text)


def _quoted(text: str) -> str:
    return "'" + text.replace("'", r"'\''") + "'"


def _roff(text: str) -> str:
    """Text that troff prints as it is."""
    plain = text.replace("\\", r"\e").replace("-", r"\-").replace("…", "...")
    return rf"\&{plain}" if plain.startswith((".", "'")) else plain


if __name__ == "__main__":
    write(Path(sys.argv[1]))
