"""`taxeld-train evaluate proposals` and `frontier`: samplers on objects and skins."""

from pathlib import Path

from taxeld_training.jobs import tables
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import EXACT
from taxeld_training.samplers.runs import DISTANCE_KEYS, FRONTIER_COLUMNS, rows, settings

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
    made = [row for row in rows("proposals", options) if row["proposal"] in PROPOSALS]
    found = tables.compared([{key: row[key] for key in PROPOSALS_KEYS} for row in made])
    data = write(options, name, found)
    tables.save(tables.samplers(found), data)
    pictures = [data.with_suffix(".png"), data.with_name(f"{data.stem}_posterior.png")]
    sampler_charts.proposals(found, pictures[0])
    sampler_charts.posterior_gap(found, pictures[1])
    return [data, *pictures]


def frontier(options: Options) -> list[Path]:
    """Cost against distance to the exact posterior: rows, table and picture of each skin."""
    from taxeld_training.charts import sampler_charts  # noqa: PLC0415

    skins = sorted({cell.columns for cell in settings(options, FRONTIER_COLUMNS)})
    names = {columns: f"frontier{_of_skin(options) or f'_{columns}'}" for columns in skins}
    made = rows("frontier", options)
    written = []
    for columns, name in names.items():
        found = tables.compared([row for row in made if row["columns"] == columns])
        if made and not found:
            continue  # time ran out before this skin
        data = write(options, name, found)
        tables.save(tables.samplers(found), data)
        sampler_charts.frontier(found, columns, data.with_suffix(".png"))
        written += [data, data.with_suffix(".png")]
    return written


def _of_skin(options: Options) -> str:
    """In a file's name: rows of another skin stand beside those of the rings."""
    return f"_{Path(options.skin).stem}" if options.skin else ""
