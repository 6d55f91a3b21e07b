"""The tables of `evaluate reliability` in Markdown."""

from collections.abc import Sequence
from typing import Any

from taxeld_training.jobs.promises import CONTACTS
from taxeld_training.jobs.rows import (
    Cell,
    Row,
    condition,
    number_of,
    object_name,
    share_of,
    table,
)


def tables(rows: Sequence[Row]) -> str:
    """Figures over many cells, reliability bin by bin, wrong objects, kidnapped ones, all cells."""
    over = [row for row in rows if "over" in row]
    single = [row for row in rows if "over" not in row]
    bins = [{"over": row["over"], **each} for row in over for each in row["reliability"]]
    wrong = [row for row in single if "told" in row]
    kidnapped = [row for row in single if "noticed" in row]
    place = {"object": _object, "condition": condition, "tuned": _tuned}
    parts = [
        table(over, {"over": lambda row: str(row["over"])}, _kept()),
        table(
            bins,
            {"over": lambda row: str(row["over"]), "p": _bin},
            {
                "n": number_of("n"),
                "mean p": number_of("mean_p"),
                "found": share_of("right"),
            },
        ),
        table(
            wrong,
            place,
            {
                "sure": share_of("sure_share"),
                "told after 6": share_of("told", "told_ci"),
            },
        ),
        table(
            kidnapped,
            place,
            {
                "noticed in 1, 2, 3": _shares("noticed"),
                "where sure before": _shares("noticed_if_sure"),
                "of": number_of("sure_before"),
            },
        ),
        table(single, place, _kept()),
    ]
    return "\n\n".join(part for part in parts if part.count("\n") > 1)


def _kept() -> dict[str, Cell]:
    """Columns of the figures that `promises.kept` has."""
    found = {
        "estimates": number_of("estimates"),
        "ECE": number_of("ece"),
        "sure": number_of("sure"),
        "misleading of these": share_of("misleading_rate"),
        "median radius, mm": number_of("radius_mm"),
    }
    found |= {f"found and sure, {k}": share_of(f"found_and_sure_{k}") for k in CONTACTS}
    return found | {f"misleading, {k}": share_of(f"misleading_{k}") for k in CONTACTS}


def _object(row: Row) -> str:
    return object_name(str(row["object"]))


def _tuned(row: Row) -> str:
    return "yes" if row["tuned"] else "no"


def _bin(row: Row) -> str:
    return f"{row['from']:.1f} …"


def _shares(key: str) -> Cell:
    def text(rows: list[Row]) -> str:
        values: Sequence[Any] = rows[0][key]
        return ", ".join("" if value is None else f"{value:.0%}" for value in values)

    return text
