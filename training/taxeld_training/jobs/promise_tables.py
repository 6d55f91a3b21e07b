"""The tables of `evaluate reliability` in Markdown."""

from collections.abc import Sequence
from typing import Any

from taxeld_training.jobs.promises import CONTACTS
from taxeld_training.jobs.rows import Cell, Row, condition, object_name, table


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
            {"n": _number("n"), "mean p": _number("mean_p"), "found": _share("right", "right_ci")},
        ),
        table(
            wrong,
            place,
            {
                "sure": _share("sure_share", "sure_share_ci"),
                "told after 6": _share("told", "told_ci"),
            },
        ),
        table(
            kidnapped,
            place,
            {
                "noticed in 1, 2, 3": _shares("noticed"),
                "where sure before": _shares("noticed_if_sure"),
                "of": _number("sure_before"),
            },
        ),
        table(single, place, _kept()),
    ]
    return "\n\n".join(part for part in parts if part.count("\n") > 1)


def _kept() -> dict[str, Cell]:
    """Columns of the figures that `promises.kept` has."""
    found = {
        "estimates": _number("estimates"),
        "ECE": _number("ece"),
        "sure": _number("sure"),
        "misleading of these": _share("misleading_rate", "misleading_ci"),
        "median radius, mm": _number("radius_mm"),
    }
    found |= {f"found and sure, {k}": _share(f"found_and_sure_{k}") for k in CONTACTS}
    return found | {f"misleading, {k}": _share(f"misleading_{k}") for k in CONTACTS}


def _object(row: Row) -> str:
    return object_name(str(row["object"]))


def _tuned(row: Row) -> str:
    return "yes" if row["tuned"] else "no"


def _bin(row: Row) -> str:
    return f"{row['from']:.1f} …"


def _number(key: str) -> Cell:
    def text(rows: list[Row]) -> str:
        value = rows[0][key]
        return "" if value is None else f"{value:g}"

    return text


def _share(key: str, interval: str = "") -> Cell:
    def text(rows: list[Row]) -> str:
        value: float | None = rows[0][key]
        if value is None:
            return ""
        if not interval:
            return f"{value:.1%}"
        low, high = rows[0][interval]
        return f"{value:.2%} ({100 * low:.2f} – {100 * high:.2f})"

    return text


def _shares(key: str) -> Cell:
    def text(rows: list[Row]) -> str:
        values: Sequence[Any] = rows[0][key]
        return ", ".join("" if value is None else f"{value:.0%}" for value in values)

    return text
