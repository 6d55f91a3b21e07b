"""Plain words: `make lint` refuses a second class of a name, comments that hide their subject, and
statements kept from the formatter.

A private class, with an underscore, may share its name with another file's. A comment that begins
with "what", "that of" or "those" cannot be read alone. Tables of numbers alone may have their own
form.
"""

import ast
import io
import re
import sys
import tokenize
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = ("firmware_protocol", "daemon", "training", "hil", "ros2")
OTHERS = ("benchmarks", "deploy", "examples")
RIDDLE = re.compile(r"#:? *(what|that of|those)\b", re.IGNORECASE)


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


def riddles(path: Path) -> list[str]:
    """A line for each comment that begins with a word without its noun."""
    text = path.read_text(encoding="utf-8")
    return [
        f"{path.relative_to(ROOT)}:{token.start[0]}: {token.string}"
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT and RIDDLE.match(token.string)
    ]


def unformatted(path: Path) -> list[str]:
    """A line for each `fmt: skip` of a statement with more words than numbers."""
    found, counts = [], {tokenize.NUMBER: 0, tokenize.NAME: 0, tokenize.STRING: 0}
    text = path.read_text(encoding="utf-8")
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in counts:
            counts[token.type] += 1
        elif token.type == tokenize.COMMENT and "fmt: skip" in token.string:
            if counts[tokenize.NUMBER] < counts[tokenize.NAME] + counts[tokenize.STRING]:
                found.append(f"{path.relative_to(ROOT)}:{token.start[0]}: fmt: skip of no numbers")
        elif token.type == tokenize.NEWLINE:
            counts = dict.fromkeys(counts, 0)
    return found


if __name__ == "__main__":
    files = sorted(path for source in (*SOURCES, *OTHERS) for path in (ROOT / source).rglob("*.py"))
    tests = sorted((ROOT / "tests").rglob("*.py"))
    faults = classes(files)
    faults += [line for path in files for line in riddles(path)]
    faults += [line for path in files + tests for line in unformatted(path)]
    sys.stdout.writelines(f"{line}\n" for line in faults)
    sys.exit(bool(faults))
