"""Options that the measurements of the harness and of the training share."""

from collections.abc import Sequence
from pathlib import Path

from taxeld.command_line import Argument, given
from taxeld.errors import SetupError
from taxeld_hil.jobs import layout_name

MEMORY = Path(".experiments")  # finished jobs; what was interrupted goes on from them
OWN = "own"  # `--layout` of what a row is of without that option


def layout_option(own: str) -> Argument:
    """The option `--layout`, which makes rows for each layout that it names."""
    about = f"make rows for it, as skin.layout; may be repeated; '{OWN}': {own} (the default)"
    return given("--layout", "LAYOUT", about, action="append")


def layouts(named: Sequence[str] | None) -> list[str]:
    """The layouts that `--layout` named, "" for OWN.

    Raises:
        SetupError: rows of two could not be told apart.
    """
    found: dict[str, str] = {}
    for spec in named or [OWN]:
        kept = "" if spec == OWN else spec if ":" in spec else str(Path(spec).resolve())
        if found.setdefault(layout_name(kept), kept) != kept:
            raise SetupError(f"--layout: two are called {layout_name(kept)}; rename a file")
    return list(found.values())


def _workers(text: str) -> int | str:
    return text if "://" in text else int(text)


JOBS = "jobs at a time, one thread each, or the address of a running Dask scheduler"
WORKERS = given("--workers", "N|ADDRESS", JOBS, _workers, default=2)
