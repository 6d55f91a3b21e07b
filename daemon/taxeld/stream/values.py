"""The values of `/taxeld/health`: what each is, and what to do where one that has a cure is not 0.

Nothing but the rows of values.md is published; docs/stream.md has them, `taxeld status` the cures.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TABLE = Path(__file__).with_name("values.md").read_text(encoding="utf-8").splitlines()


def expanded(key: str) -> list[str]:
    """`a.{b,c}` → `a.b` and `a.c`."""
    head, brace, rest = key.partition("{")
    if not brace:
        return [key]
    names, _, tail = rest.partition("}")
    return [head + name + more for name in names.split(",") for more in expanded(tail)]


def _cures() -> Iterator[tuple[str, str]]:
    for row in TABLE:
        keys, _, what = row.partition(": ")
        cure = what.partition(" → ")[2].replace("`", "")
        for key in re.findall("`(.*?)`", keys):
            for name in expanded(key):
                yield name.removesuffix("[]"), re.sub(r"\[(.*?)\]\((.*?)\)", r"\1: docs/\2", cure)


CURES = dict(_cures())  # the cure of each value, where there is one


def cure(name: str) -> str | None:
    """What to do where it is not 0, empty where there is nothing; None: not in the table."""
    return CURES.get(name, CURES.get(f"{name.rpartition('.')[0]}.*"))


def published(counted: dict[str, Any], path: str = "") -> dict[str, Any]:
    """All of `counted` that is in the table; `links` has a map of each link."""
    found: dict[str, Any] = {}
    for key, value in counted.items():
        name = path + key
        if name == "links":
            found[key] = {link: published(each) for link, each in value.items()}
        elif isinstance(value, dict):
            found[key] = published(value, f"{name}.")
        elif cure(name) is not None or name == "why":  # of a link
            found[key] = value
    return found


def amiss(health: dict[str, Any], path: str = "") -> Iterator[str]:
    """Each value that is not 0 and has a cure, with it."""
    for key, value in health.items():
        name = path + key
        if isinstance(value, dict) and name != "links":
            yield from amiss(value, f"{name}.")
        elif value and (advice := cure(name)):
            told = ", ".join(map(str, value)) if isinstance(value, list) else int(value)
            yield f"{name} {told}: {advice}"
