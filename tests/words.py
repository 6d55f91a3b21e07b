"""One name, one class: `make lint` refuses a public class whose name another file has as well.

A private class, with an underscore, may share its name with another file's.
"""

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = (
    "firmware_protocol",
    "daemon",
    "training",
    "hil",
    "ros2",
    "benchmarks",
    "deploy",
    "examples",
)


def classes(paths: list[Path]) -> list[str]:
    """A line for each public class whose name another one has."""
    found = defaultdict(list)
    for path in paths:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    return [
        f"{', '.join(places)}: class {name} {len(places)} times"
        for name, places in sorted(found.items())
        if len(places) > 1
    ]


if __name__ == "__main__":
    faults = classes(sorted(path for each in SOURCES for path in (ROOT / each).rglob("*.py")))
    sys.stdout.writelines(f"{line}\n" for line in faults)
    sys.exit(bool(faults))
