"""The keys and types that docs/stream.md has of each message, and the clients' example of it."""

import json
import re
from pathlib import Path
from typing import Any

from taxeld.stream.values import expanded

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs" / "stream.md"
EXAMPLES = ROOT / "examples" / "clients" / "messages.json"
Types = dict[str, str]
EACH = {"v": "int", "seq": "int", "t": "float"}  # keys of all topics of a scan, named once


def leaves(value: object, path: str = "") -> Types:
    """Path of each number, text or truth value → its type; `[]` stands for each of a list, `*`
    for each of a map whose keys are numbers, or names of objects or causes."""
    found: Types = {}
    if isinstance(value, dict):
        for key, item in value.items():
            is_any = key.isdigit() or path.endswith((".objects", ".dropped", ".bus"))
            found |= leaves(item, f"{path}.*" if is_any else f"{path}.{key}")
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
    """The keys of a section's list with their types, and the topic's example."""
    rows = re.findall(r"^- (`.*?`) \((\w+)\): ", section(title), re.MULTILINE)
    named = [(re.findall("`(.*?)`", names), kind) for names, kind in rows]
    keys = {key: kind for names, kind in named for name in names for key in expanded(name)}
    keys |= {} if title in ("/taxeld/info", "/robot/sensor_pose") else EACH
    return keys, json.loads(EXAMPLES.read_text(encoding="utf-8"))[title]
