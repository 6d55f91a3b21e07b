"""Common to the four programs: help with examples, `--version`, and for each fault one line and an
exit status.

It is imported before the command is known, so it imports nothing slow.
"""

import argparse
import inspect
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from taxeld import __version__
from taxeld.errors import SetupError, WorkError

FAILED, USAGE_ERROR = 1, 2
STDERR = 2  # the last standard stream's number
# numpy's libraries have one thread: others would spin while they wait, and compete for the loop's
# core. Variables set before win
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
PACKAGES = {"rerun": "rerun-sdk"}  # of modules that have another name

Run: TypeAlias = Callable[[argparse.Namespace], int]
Argument: TypeAlias = tuple[tuple[str, ...], dict[str, Any]]  # of `add_argument`
Arguments: TypeAlias = Sequence[Argument | list[Argument]]  # those of a list exclude each other


def parser(prog: str, text: str, *examples: str) -> argparse.ArgumentParser:
    """The parser of a program; its commands are added by `add_commands`."""
    return _usable(argparse.ArgumentParser(prog=prog, **_help(text, examples)))


def given(name: str, values: str, about: str, kind: Any = str, **how: Any) -> Argument:
    """An argument with the named `values`, each of a `kind`."""
    names = tuple(values.split())
    if len(names) > 1:
        return (name,), {"nargs": len(names), "metavar": names, "type": kind, "help": about} | how
    return (name,), {"metavar": values, "type": kind, "help": about} | how


def natural(text: str) -> int:
    """A number of an argument that has none below 0."""
    if (number := int(text)) < 0:
        raise argparse.ArgumentTypeError(f"must be 0 or more, not {number}")
    return number


def flag(name: str, about: str) -> Argument:
    return (name,), {"action": "store_true", "help": about}


def add_commands(parent: argparse.ArgumentParser, table: Mapping[Run, Arguments]) -> None:
    """Add the commands `_name`, of which a docstring has a sentence, and an example a line. One of
    a list of arguments must be given, unless one has a default."""
    commands = parent.add_subparsers(required=True, metavar="COMMAND", title="commands")
    for run, arguments in table.items():
        written = run.__doc__ or inspect.getsource(run).split('"""')[1]  # python -OO drops it
        text, *examples = filter(None, inspect.cleandoc(written).splitlines())
        name = run.__name__.lstrip("_")
        made = _usable(commands.add_parser(name, help=text, **_help(text, examples)))
        made.set_defaults(command=run, name=name)
        for argument in arguments:
            if not isinstance(argument, list):
                made.add_argument(*argument[0], **argument[1])
                continue
            needed = not any("default" in how for _, how in argument)
            group = made.add_mutually_exclusive_group(required=needed)
            for names, how in argument:
                group.add_argument(*names, **how)


def _help(text: str, examples: "tuple[str, ...] | list[str]") -> dict[str, Any]:
    listed = "\n  ".join([f"example{'s' * (len(examples) > 1)}:", *examples])
    as_written = argparse.RawDescriptionHelpFormatter  # examples keep their lines
    return {"description": text, "epilog": listed, "formatter_class": as_written}


def _usable(made: argparse.ArgumentParser) -> argparse.ArgumentParser:
    made.add_argument("--version", action="version", version=__version__)
    made.set_defaults(used=made)
    return made


def stopping() -> Callable[[], bool]:
    """From now on, whether a signal asked for the end."""
    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, lambda got, _: stopped.append(got))
    return lambda: bool(stopped)


def main(made: argparse.ArgumentParser, argv: list[str] | None, prefix: str = "") -> int:
    """Run the command of the arguments; → 0 fine, 1 failed at work, 2 wrong arguments or
    configuration. `prefix` begins each line on a fault."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    _open_standard()
    typed, status = sys.argv[1:] if argv is None else argv, USAGE_ERROR
    try:
        args, unknown = made.parse_known_args(typed)
        if unknown:
            args.used.error(f"unrecognized arguments: {' '.join(unknown)}")
        return int(args.command(args))
    except SetupError as error:
        lines, status = str(error), FAILED if isinstance(error, WorkError) else USAGE_ERROR
    except ModuleNotFoundError as error:
        lines = _missing(error, made.prog)
        if not lines:
            raise
    except BrokenPipeError:  # the reader of the output has gone: `taxeld decode LOG | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    print("\n".join(prefix + line for line in lines.splitlines()), file=sys.stderr)
    return status


def _missing(error: ModuleNotFoundError, prog: str) -> str:
    """A line on a module that is not installed, with the command that installs its extra's needs:
    by its own name taxeld is on no index, and the clone that it came from may be gone. Empty
    where no extra has it. Of several extras, the one for the program `prog`, or the first."""
    from importlib import metadata  # noqa: PLC0415  (slow, and seldom needed)

    module = (error.name or "").split(".")[0]
    package = PACKAGES.get(module, module.replace("_", "-"))
    extras: dict[str, list[str]] = {}
    for installed in metadata.distributions(name="taxeld"):
        for need in installed.requires or ():
            name, _, extra = need.partition("; extra == ")
            extras.setdefault(extra.strip("'\""), []).append(name)
    for extra in sorted(extras, key=lambda extra: not prog.endswith(extra)):
        if any(re.match(rf"{package}\b", need) for need in extras[extra]):
            install = f"{sys.executable} -m pip install {shlex.join(extras[extra])}"
            return f"this needs {module}, which is not installed: {install}"
    return ""


def _open_standard() -> None:
    """Open closed standard streams to /dev/null: a device would otherwise get their numbers and be
    written to."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= STDERR:
        os.set_inheritable(number, True)
    os.close(number)
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8"))
