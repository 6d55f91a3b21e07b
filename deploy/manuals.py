"""Manual pages and shell completions of the commands, made from their argument parsers.

The wheel holds them (hatch_build.py), so a computer on which it is installed needs neither
argparse-manpage nor shtab.
"""

from argparse import ArgumentParser, _SubParsersAction
from importlib import import_module

import shtab
from argparse_manpage.manpage import Manpage

PROGRAMS = {
    "taxeld": "taxeld.cli",
    "taxeld-train": "taxeld_training.cli",
    "taxeld-hil": "taxeld_hil.cli",
    "taxeld-ros2": "taxeld_ros2.cli",
}
STATUS = "0: fine. 1: failed at work. 2: wrong arguments or configuration."


def files() -> dict[str, str]:
    """The text of each page and completion, by its path below a prefix."""
    found = {}
    for program, module in PROGRAMS.items():
        parser: ArgumentParser = import_module(module)._parser()
        for one in (parser, *commands_of(parser).values()):
            for action in one._actions:
                if action.choices is None and action.nargs != 0:
                    action.complete = shtab.FILE  # type: ignore[attr-defined]
        found[f"share/bash-completion/completions/{program}"] = shtab.complete(parser, "bash")
        found[f"share/zsh/site-functions/_{program}"] = shtab.complete(parser, "zsh")
        found[f"share/man/man1/{program}.1"] = manual(parser)
    return found


def manual(parser: ArgumentParser) -> str:
    """The page of a program for section 1, without a date, so that every build makes the same."""
    for command in commands_of(parser).values():
        command.description = command.epilog  # the page has the sentence already
    page = Manpage(parser, format="single-commands-section")
    page.description = (parser.description or "").partition(".")[0]
    page.date, page.source, page.manual = "", "taxeld", "taxeld"
    page.add_section("exit status", "=", STATUS)
    return str(page)


def commands_of(parser: ArgumentParser) -> dict[str, ArgumentParser]:
    """The commands of a program by name; empty where it has none."""
    found = [a for a in parser._actions if isinstance(a, _SubParsersAction)]
    return dict(found[0].choices) if found else {}
