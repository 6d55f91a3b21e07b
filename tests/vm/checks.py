"""The checks, in the order in which they are written down."""

from collections.abc import Callable

CHECKS: list[Callable[[], str | None]] = []


def check(function: Callable[[], str | None]) -> Callable[[], str | None]:
    CHECKS.append(function)
    return function
