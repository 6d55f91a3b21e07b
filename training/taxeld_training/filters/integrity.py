"""`taxeld-train evaluate integrity`: what misled, counted over all experiments of a folder.

Nothing is run. Whichever JSON file of the folder has rows with a `stanford` diagram is a source:
trials of what ships, soaks, scenarios.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld_hil.integrity import Stanford
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import number_of, table

NAME, ALL = "integrity", "all"
COUNTS = {  # heading → key of a row
    "estimates": "estimates",
    "sure": "sure",
    "misleading": "misleading",
    "found, beyond its radius": "beyond",
    "not found, within it": "far",
    "not found, beyond it": "far_beyond",
}


def integrity_rows(options: Options) -> list[Path]:
    """Rows {source, estimates, sure, misleading, kept, beyond, far, far_beyond, bins}, their table
    and their diagrams. The first row is of all sources.

    Raises:
        SetupError: no file of the folder has diagrams.
    """
    from taxeld_training.charts import stanford_chart  # noqa: PLC0415  # matplotlib is not needed to train

    each = diagrams(options.out)
    if not each:
        raise SetupError(f"--out: {options.out} has no diagrams; run reliability first")
    if len(each) > 1:
        whole = Stanford()
        for diagram in each.values():
            whole.include(diagram)
        each = {ALL: whole, **each}
    rows = [{"source": source, **diagram.row()} for source, diagram in each.items()]
    data = write(options, NAME, rows, _table(rows))
    stanford_chart.draw(each, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def diagrams(folder: Path) -> dict[str, Stanford]:
    """The diagram of each JSON file in a folder that has any, by the name of the file."""
    found = {}
    for path in sorted(folder.glob("*.json")):
        if path.stem != NAME:
            whole = Stanford.of_rows(_told(json.loads(path.read_text(encoding="utf-8"))))
            if whole.estimates:
                found[path.stem] = whole
    return found


def _told(data: Any) -> Iterator[Mapping[str, Any]]:
    """The rows of diagrams anywhere in JSON."""
    if isinstance(data, list):
        for each in data:
            yield from _told(each)
    elif isinstance(data, dict):
        for key, each in data.items():
            if key == "stanford" and each is not None:
                yield each
            else:
                yield from _told(each)


def _table(rows: list[dict[str, Any]]) -> str:
    cells = {heading: number_of(key) for heading, key in COUNTS.items()}
    return table(rows, {"source": lambda row: str(row["source"])}, cells)
