"""The checks, in the order in which they are written down, and what has come of them.

What a check came to is stored before the next one begins: a machine whose power was cut goes on
where it was when it is booted again.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path

CHECKS: list[Callable[[], str | None]] = []
ONLY = Path("/vm/only")  # a text: the other checks, whose names do not hold it, are left out
ENDED = Path("/vm/ended")  # a line a check
CUT = "cut the power"  # what tests/vm/run waits for
CUT_S = 60.0


def check(function: Callable[[], str | None]) -> Callable[[], str | None]:
    CHECKS.append(function)
    return function


def named(function: Callable[[], str | None]) -> str:
    return function.__name__.replace("_", " ")


def asked_for() -> list[Callable[[], str | None]]:
    only = ONLY.read_text(encoding="utf-8").strip() if ONLY.exists() else ""
    return [function for function in CHECKS if only in named(function)]


def ended() -> dict[str, str]:
    """Of each check that has ended, in this boot or before: `passed` or `FAILED`."""
    lines = ENDED.read_text(encoding="utf-8").splitlines() if ENDED.exists() else []
    return {name: outcome for outcome, name in (line.split(" ", 1) for line in lines)}


def has_ended(name: str, outcome: str) -> None:
    store(ENDED, f"{outcome} {name}\n")


def store(path: Path, text: str) -> None:
    """Append `text`, on the disk and not in memory alone."""
    with path.open("a", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def cut_the_power() -> None:
    """Does not return, but where nobody does so."""
    print(CUT, flush=True)
    time.sleep(CUT_S)
    raise AssertionError("the power was not cut")
