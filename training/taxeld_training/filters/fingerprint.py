"""What decides the results of trials: a hash of the code, for the keys of their jobs."""

import ast
import hashlib
from functools import cache
from importlib import resources
from pathlib import Path

from taxeld.config.tables import FilterConfig
from taxeld_training.jobs.rows import GRID

# what decides a filter's estimates in a trial; where it has particles, their samples as well
ROOMS = ("taxeld.model", "taxeld.estimator", "taxeld_training.filters")
SAMPLES = ("taxeld.proposals",)


@cache
def of(proposal: str) -> str:
    """Hash of the code that decides a trial's results with such a proposal, so that other code is
    another job. Docstrings, comments and layout do not count."""
    rooms = ROOMS if proposal == GRID else ROOMS + SAMPLES
    folders = [Path(str(resources.files(room))) for room in rooms]
    files = [file for folder in folders for file in sorted(folder.glob("*.py"))]
    if proposal == GRID:
        files += sorted(Path(str(resources.files("taxeld_training.limits"))).glob("grid_*.py"))
    digest = hashlib.sha256(repr(FilterConfig()).encode())
    for file in files:
        digest.update(_bare(file.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()[:12]


def _bare(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)
