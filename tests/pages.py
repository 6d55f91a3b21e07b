"""What pages and notebooks show is run: their code, in its order, in a directory of its own.

    python tests/pages.py NOTEBOOK DIRECTORY

runs a notebook there, and keeps in it what it prints and the `figure` that it draws.
"""

import base64
import contextlib
import io
import json
import os
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

NUMBER = re.compile(r"-?\d+(\.\d*)?")
PYTHON = re.compile(r"```python\n(.*?)```(?:\s+```text\n(.*?)```)?", re.DOTALL)
FENCED = re.compile(r"```(\w+)\n(.*?)```", re.DOTALL)


class Block(NamedTuple):
    """A block of Python, and what the page shows of its output."""

    code: str
    shown: str


def blocks(page: Path) -> list[Block]:
    """The `python` blocks of a page in Markdown. A `text` block after one is its output."""
    return [Block(*both) for both in PYTHON.findall(page.read_text(encoding="utf-8"))]


def cells(notebook: Path) -> list[str]:
    """The code of a notebook's cells."""
    held = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in held if cell["cell_type"] == "code"]


def run(code: str, names: dict[str, Any]) -> str:
    """→ what it printed."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(code, "<page>", "exec"), names)  # noqa: S102
    return said.getvalue()


def keep_outputs(notebook: Path, place: Path) -> None:
    """Run a notebook in `place`, and write what its cells print and draw into it."""
    held = json.loads(notebook.read_text(encoding="utf-8"))
    names: dict[str, Any] = {}
    for cell in held["cells"]:
        if cell["cell_type"] != "code":
            continue
        with contextlib.chdir(place):
            said = run("".join(cell["source"]), names)
        lines = said.splitlines(keepends=True)
        printed = {"name": "stdout", "output_type": "stream", "text": lines}
        cell["outputs"] = [printed] if said else []
        figure = names.pop("figure", None)
        if figure is not None:
            drawn = io.BytesIO()
            figure.savefig(drawn, format="png", dpi=72)
            image = base64.b64encode(drawn.getvalue()).decode()
            shown = {"data": {"image/png": image}, "metadata": {}, "output_type": "display_data"}
            cell["outputs"].append(shown)
    notebook.write_text(json.dumps(held, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    os.environ["MPLBACKEND"] = "Agg"  # no window is opened
    keep_outputs(Path(sys.argv[1]), Path(sys.argv[2]).resolve())
