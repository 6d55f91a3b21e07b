"""The tables of `evaluate recognise` in Markdown."""

from collections.abc import Sequence
from typing import Any

from taxeld_training.jobs.rows import Cell, Row, object_name, table

SHOWN = (1, 2, 4, 6, 8)  # contacts that the tables speak of


def tables(rows: Sequence[Row]) -> str:
    """Figures by object, of unknown objects, and of what it costs."""
    of = {
        figure: [row for row in rows if row["figure"] == figure]
        for figure in ("identity", "unknown", "cost")
    }
    told = [row for row in of["unknown"] if "contact" in row]
    place = {"knows": lambda row: str(row["of"]), "skin": lambda row: str(row["skin"])}
    parts = [
        table(
            of["identity"],
            {**place, "object": lambda row: object_name(str(row["object"]))},
            {
                f"{heading} after {', '.join(map(str, SHOWN))}": _shares(key)
                for heading, key in (
                    ("right", "right"),
                    ("right and under 10 mm", "found"),
                    ("under 10 mm if known alone", "found_alone"),
                    ("found and sure", "found_and_sure"),
                    ("misleading", "misleading"),
                )
            },
        ),
        table(
            told,
            {**place, "contacts": lambda row: str(row["contact"])},
            {
                "AUROC of other": lambda each: f"{each[0]['auroc']:.3f}",
                "sure": lambda each: f"{each[0]['sure_then']:.2%}",
            },
        ),
        table(of["cost"], place, {heading: _cost(*keys) for heading, keys in COSTS.items()}),
    ]
    return "\n\n".join(part for part in parts if part.count("\n") > 1)


COSTS = {  # heading → keys of a filter of several objects, and of one object
    "first touch, ms": ("first_ms", "first_one_ms"),
    "second": ("second_ms", "second_one_ms"),
    "sixth and later": ("settled_ms", "settled_one_ms"),
    "worst scan of a trial, median": ("worst_median_ms", "worst_one_median_ms"),
    "worst scan": ("worst_ms", "worst_one_ms"),
}


def _shares(key: str) -> Cell:
    def text(rows: list[Row]) -> str:
        share: dict[int, Any] = {row["contact"]: row[key] for row in rows}
        return ", ".join(f"{100 * share[contact]:.3g}" for contact in SHOWN) + " %"

    return text


def _cost(several: str, one: str) -> Cell:
    def text(rows: list[Row]) -> str:
        first, second = float(rows[0][several]), float(rows[0][one])
        return f"{first:.1f} ({second:.1f}, {first / second:.2f} ×)"

    return text
