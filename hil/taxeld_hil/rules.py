"""Rules that a skin is held to, as a table of what was measured, its limit, and the cure."""

import textwrap
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from taxeld.errors import SetupError

WIDTH = 100
INDENT = " " * 7
MARKS = {True: "ok", False: "FAIL", None: "-"}


class Rule(NamedTuple):
    """One rule."""

    check: str  # the group of rules that it belongs to
    what: str
    measured: str
    limit: str = ""  # empty: the value is only worth knowing
    holds: bool | None = True  # None: it could not be checked
    cure: str = ""


def failed(rules: Iterable[Rule]) -> list[Rule]:
    """The rules that do not hold."""
    return [rule for rule in rules if rule.holds is False]


def lines(rules: Iterable[Rule]) -> Iterator[str]:
    """The table for people, with the cure of each rule that does not hold."""
    for rule in rules:
        limit = f"  [{rule.limit}]" if rule.limit not in {"", rule.measured} else ""
        text = f"{rule.check:<13}{rule.what}: {rule.measured}{limit}"
        yield from _wrapped(text, f"{MARKS[rule.holds]:<7}", INDENT + " " * 15)
        if rule.holds is False:
            yield from _wrapped(rule.cure, INDENT + " " * 13 + "→ ", INDENT + " " * 15)


def at_least(
    check: str, what: str, value: float, least: float, cure: str, form: str = ".0f"
) -> Rule:
    """The rule that a value is as large as that; `form`: how both are written."""
    limit = f"at least {least:{form}}"
    return Rule(check, what, f"{value:{form}}", limit, bool(value >= least), cure)


def require(rules: Iterable[Rule], command: str) -> None:
    """Refuse what a rule does not allow.

    Raises:
        SetupError: a rule does not hold; the first such rule is named.
    """
    for rule in failed(rules):
        raise SetupError(
            f"{command}: {rule.what}: {rule.measured}; it takes {rule.limit}; {rule.cure}"
        )


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )
