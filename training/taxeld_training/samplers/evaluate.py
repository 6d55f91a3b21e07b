"""`taxeld-train evaluate proposals` and `frontier`: samplers on objects and skins."""

from pathlib import Path

from taxeld_training.jobs import tables
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.rows import EXACT
from taxeld_training.samplers.runs import DISTANCE_KEYS, rows

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

    found = [
        {key: row[key] for key in PROPOSALS_KEYS}
        for row in rows("proposals", options) if row["proposal"] in PROPOSALS
    ]  # fmt: skip
    data = write(options, f"proposals{_of_skin(options)}", found)
    tables.write(found, data)
    pictures = [data.with_suffix(".png"), data.with_name(f"{data.stem}_posterior.png")]
    sampler_charts.proposals(found, pictures[0])
    sampler_charts.posterior_gap(found, pictures[1])
    return [data, *pictures]


def frontier(options: Options) -> list[Path]:
    """Cost against distance to the exact posterior."""
    from taxeld_training.charts import sampler_charts  # noqa: PLC0415

    found = rows("frontier", options)
    data = write(options, f"frontier{_of_skin(options)}", found)
    tables.write(found, data)
    pictures = []
    for columns in sorted({row["columns"] for row in found}):
        pictures.append(data.with_name(f"{data.stem}_{columns}.png"))
        sampler_charts.frontier(found, columns, pictures[-1])
    return [data, *pictures]


def _of_skin(options: Options) -> str:
    """In a file's name: rows of another skin stand beside those of the rings."""
    return f"_{Path(options.skin).stem}" if options.skin else ""
