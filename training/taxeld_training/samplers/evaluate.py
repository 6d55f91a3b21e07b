"""`taxeld-train evaluate proposals` and `frontier`: samplers on objects and skins."""

import json
import math
from pathlib import Path
from typing import Any, TypeAlias

from taxeld.errors import SetupError
from taxeld_training.jobs import tables
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import DISTANCES, EXACT, joined
from taxeld_training.samplers.runs import DISTANCE_KEYS, FRONTIER_COLUMNS, rows, settings

Rows: TypeAlias = list[dict[str, Any]]

SAME_FLOOR = 0.01  # a share: the same readings on another machine are rounded otherwise

PROPOSALS = (  # the paper's Fig. 2, and limits
    "projection", "manifold", "table", "paper", "density", EXACT,
)  # fmt: skip
PROPOSALS_KEYS = (
    "object", "columns", "proposal",
    *(
        key + end
        for key in ("add_mm", "add_s_mm", "add_sym_mm", "contact_residual_mm",
                    "observation_residual", "coverage_90")
        for end in ("", "_ci")
    ),
    *DISTANCE_KEYS, "contacts",
)  # fmt: skip


def proposals(options: Options) -> list[Path]:
    """The paper's Fig. 2: errors of samples by object and resolution."""
    from taxeld_training.charts import sampler_charts  # noqa: PLC0415  # matplotlib is not needed to train

    name = f"proposals{_of_skin(options)}"
    earlier = _earlier(options, name)
    made = [
        {key: row[key] for key in PROPOSALS_KEYS}
        for row in rows("proposals", options) if row["proposal"] in PROPOSALS
    ]  # fmt: skip
    found = _together(earlier, made)
    data = write(options, name, found)
    tables.write(found, data)
    pictures = [data.with_suffix(".png"), data.with_name(f"{data.stem}_posterior.png")]
    sampler_charts.proposals(found, pictures[0])
    sampler_charts.posterior_gap(found, pictures[1])
    return [data, *pictures]


def frontier(options: Options) -> list[Path]:
    """Cost against distance to the exact posterior: rows, table and picture of each skin."""
    from taxeld_training.charts import sampler_charts  # noqa: PLC0415

    skins = sorted({cell.columns for cell in settings(options, FRONTIER_COLUMNS)})
    names = {columns: f"frontier{_of_skin(options) or f'_{columns}'}" for columns in skins}
    earlier = {columns: _earlier(options, name) for columns, name in names.items()}
    made = rows("frontier", options)
    written = []
    for columns, name in names.items():
        of_skin = [row for row in made if row["columns"] == columns]
        if not (found := _together(earlier[columns], of_skin)):
            continue  # out of time
        data = write(options, name, found)
        tables.write(found, data)
        sampler_charts.frontier(found, columns, data.with_suffix(".png"))
        written += [data, data.with_suffix(".png")]
    return written


def _earlier(options: Options, name: str) -> Rows:
    """With `--add` the rows of the file as it is.

    Raises:
        SetupError: they are of a version that left the distances out.
    """
    path = options.out / f"{name}.json"
    if not options.add or not path.is_file():
        return []
    found: Rows = json.loads(path.read_text(encoding="utf-8"))
    if not all(DISTANCES in row for row in found):
        raise SetupError(f"--add: {path} has rows without distances; move it away")
    return found


def _together(earlier: Rows, made: Rows) -> Rows:
    """Rows and the earlier ones that none of them replaces, compared with each other.

    Raises:
        SetupError: an earlier row is of other readings than those made now.
    """
    floors = {(row["object"], row["columns"]): row["energy_floor"] for row in made}
    for row in earlier:
        floor = floors.get((row["object"], row["columns"]))
        if floor and not math.isclose(floor, row["energy_floor"], rel_tol=SAME_FLOOR):
            raise SetupError(
                f"--add: the rows of {row['object']} there are of other readings; "
                "write to another folder"
            )
    return tables.compared(joined(earlier, made))


def _of_skin(options: Options) -> str:
    """In a file's name: rows of another skin stand beside those of the rings."""
    return f"_{Path(options.skin).stem}" if options.skin else ""
