"""The keys, types and examples that docs/stream.md has of each message."""

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs" / "stream.md"
Types = dict[str, str]


def leaves(value: object, path: str = "") -> Types:
    """Path of each number, text or truth value → its type; `[]` stands for each of a list, `*`
    for each of a map whose keys are numbers, or names of objects."""
    found: Types = {}
    if isinstance(value, dict):
        for key, item in value.items():
            found |= leaves(
                item, f"{path}.*" if key.isdigit() or path.endswith(".objects") else f"{path}.{key}"
            )
    elif isinstance(value, list):
        for item in value:
            found |= leaves(item, f"{path}[]")
    else:
        return {path.removeprefix("."): type(value).__name__}
    return found


def section(title: str) -> str:
    text = DOCUMENT.read_text(encoding="utf-8")
    return text.split(f"\n## `{title}`\n", maxsplit=1)[1].split("\n## ", maxsplit=1)[0]


def documented(title: str) -> tuple[Types, dict[str, Any]]:
    """The keys of a section's table with their types, and its example."""
    part = section(title)
    rows = [line.split("|")[1:3] for line in part.splitlines() if line.startswith("| `")]
    example = part.split("```json\n", maxsplit=1)[1].split("```", maxsplit=1)[0]
    keys = {key: kind.strip() for text, kind in rows for key in expanded(text.strip().strip("`"))}
    return keys, json.loads(example)


def expanded(key: str) -> list[str]:
    """`a.{b,c}` → `a.b` and `a.c`."""
    head, brace, rest = key.partition("{")
    if not brace:
        return [key]
    names, _, tail = rest.partition("}")
    return [head + name + more for name in names.split(",") for more in expanded(tail)]
