"""Options that the measurements of the harness and of the training share."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from taxeld.errors import SetupError
from taxeld_hil.jobs import layout_name

MEMORY = Path(".experiments")  # finished jobs; what was interrupted goes on from them
OWN = "own"  # `--layout` of what a row is of without that option


def add_layouts(made: argparse.ArgumentParser, own: str) -> argparse.Action:
    """Add the option `--layout`, which makes rows for each layout that it names."""
    about = f"make rows for it, as skin.layout; may be repeated; '{OWN}': {own} (the default)"
    return made.add_argument("--layout", action="append", metavar="LAYOUT", help=about)


def layouts(given: Sequence[str] | None) -> list[str]:
    """The layouts that `--layout` named, "" for OWN.

    Raises:
        SetupError: rows of two could not be told apart.
    """
    found: dict[str, str] = {}
    for spec in given or [OWN]:
        kept = "" if spec == OWN else spec if ":" in spec else str(Path(spec).resolve())
        if found.setdefault(layout_name(kept), kept) != kept:
            raise SetupError(f"--layout: two are called {layout_name(kept)}; rename a file")
    return list(found.values())


def _workers(text: str) -> int | str:
    return text if "://" in text else int(text)


def add_workers(made: argparse.ArgumentParser) -> None:
    """Add the option of how many jobs run at a time; what they found is in MEMORY."""
    about = "jobs at a time, one thread each, or the address of a running Dask scheduler"
    made.add_argument("--workers", type=_workers, default=2, metavar="N|ADDRESS", help=about)
    made.set_defaults(memory=MEMORY)


def add_jobs(made: argparse.ArgumentParser) -> None:
    """Add the options of `jobs.run`."""
    add_workers(made)
    about = "finished jobs; what was interrupted goes on from them (default %(default)s)"
    made.add_argument("--memory", type=Path, default=MEMORY, metavar="DIR", help=about)
