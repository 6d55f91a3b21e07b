"""The filter experiment's picture and table from its rows."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from taxeld_training.charts import picture
from taxeld_training.jobs.rows import GRID, SUCCESS_MM, Row, object_name

ACROSS = 5  # objects side by side
DASHES = {"mixture": "-", "paper": (0, (3, 1.5)), "": "-"}
BANDS = (("density", "mixture"), (GRID, ""))  # 10 % to 90 % of their trials is shaded
SHOWN_MM = (0.05, 300.0)
AT_SUCCESS, AT_ERROR = (6, 8), 3  # contacts, after which the table has success and error


LineStyle = tuple[str, Any, float]  # colour, dashes, width
# lines have no markers, so the grid takes the colour of a sampler that no filter is compared with
OWN = {GRID: picture.COLOURS[1]}


def name_of(row: Row) -> str:
    """The method's name in legends and tables."""
    words = [str(row["proposal"]), str(row["injection"])]
    if row["particles_max"] > row["particles"]:
        words.append(f"{row['particles']}..{row['particles_max']}")
    return " ".join(word for word in words if word)


def draw(rows: Sequence[Row], path: Path) -> None:
    """An object a column: the error of the estimate above, the share of good ones below."""
    objects = list(dict.fromkeys(row["object"] for row in rows))
    styles = line_styles(rows)
    down, across = -(-len(objects) // ACROSS), min(ACROSS, len(objects))
    figure = Figure(figsize=(max(2.2 * across, 5.0), 3.9 * down + 0.6), layout="constrained")
    panels = figure.subplots(2 * down, across, sharex=True, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for i, name in enumerate(objects):
        above, below = (
            panels[2 * (i // ACROSS), i % ACROSS],
            panels[2 * (i // ACROSS) + 1, i % ACROSS],
        )
        _errors(above, [row for row in rows if row["object"] == name], styles)
        _successes(below, [row for row in rows if row["object"] == name], styles)
        above.set_title(object_name(name), fontsize=9, pad=3)
        if i % ACROSS == 0:
            above.set_ylabel("error of the MAP [mm]", fontsize=8)
            below.set_ylabel(f"trials under {SUCCESS_MM:g} mm", fontsize=8)
        above.tick_params(labelleft=i % ACROSS == 0)
        below.tick_params(labelleft=i % ACROSS == 0)
        below.set_xlabel("contacts", fontsize=8)
    handles = [
        Line2D([], [], color=colour, ls=dashes, lw=width, label=label)
        for label, (colour, dashes, width) in styles.items()
    ]
    figure.legend(
        handles=handles, loc="outside upper center", ncols=min(len(handles), across + 1),
        fontsize=8, frameon=False, columnspacing=1.5,
    )  # fmt: skip
    picture.save(figure, path, palette=True)


def table(rows: Sequence[Row], path: Path) -> None:
    """Success and error by object and method, in Markdown."""
    objects = list(dict.fromkeys(row["object"] for row in rows))
    methods = list(dict.fromkeys(name_of(row) for row in rows))

    def grid(what: str, contact: int, cell: str) -> str:
        of = {(row["object"], name_of(row)): row for row in rows if row["contact"] == contact}
        lines = [["object", *methods], ["---"] * (len(methods) + 1)]
        lines += [
            [object_name(o), *(_cell(of[o, m], cell) if (o, m) in of else "" for m in methods)]
            for o in objects
        ]
        return "\n".join([f"{what}:", "", *("| " + " | ".join(line) + " |" for line in lines)])

    parts = [
        *(
            grid(f"Trials under {SUCCESS_MM:g} mm after {contact} contacts (95 % interval; p: as "
                 "good as what ships)", contact, "success")
            for contact in AT_SUCCESS
        ),
        grid(f"Median error of the MAP after {AT_ERROR} contacts, mm", AT_ERROR, "error"),
        grid(f"Silent failures at contact {AT_SUCCESS[-1]} / at any up to it", AT_SUCCESS[-1],
             "silent"),
    ]  # fmt: skip
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _cell(row: Row, kind: str) -> str:
    if kind == "silent":
        if row["silent_failure_rate"] is None:
            return ""
        return f"{row['silent_failure_rate']:.1%} / {row['silent_so_far_rate']:.1%}"
    if kind == "error":
        low, high = row["map_mm_ci"]
        return f"{row['map_mm']['median']:.2g} ({low:.2g} – {high:.2g})"
    low, high = row["success_ci"]
    p = "" if row["p_shipped"] in (None, 1.0) else f", p {row['p_shipped']:.2g}"
    return f"{row['success_rate']:.1%} ({100 * low:.0f} – {100 * high:.0f}{p})"


def line_styles(rows: Iterable[Row]) -> dict[str, LineStyle]:
    """Colour by proposal, dashes by injection; the adaptive one is thick."""
    rows = list(rows)
    colours = picture.styles(str(row["proposal"]) for row in rows)
    found: dict[str, LineStyle] = {}
    for row in rows:
        colour = OWN.get(row["proposal"], colours[row["proposal"]][0])
        width = 2.6 if row["particles_max"] > row["particles"] else 1.2
        found[name_of(row)] = (colour, DASHES[row["injection"]], width)
    return found


def _errors(axes: Axes, rows: Sequence[Row], styles: dict[str, LineStyle]) -> None:
    axes.set_axis_on()
    for name, mine in _by_method(rows).items():
        colour, dashes, width = styles[name]
        x = [row["contact"] for row in mine]
        low, mid, high = (
            np.clip([row["map_mm"][key] for row in mine], *SHOWN_MM)
            for key in ("q10", "median", "q90")
        )
        axes.plot(x, mid, color=colour, ls=dashes, lw=width, alpha=0.9)
        if (mine[0]["proposal"], mine[0]["injection"]) in BANDS and width < 2.0:
            axes.fill_between(x, low, high, color=colour, alpha=0.12, lw=0)
    axes.axhline(SUCCESS_MM, color="0.45", lw=0.8, ls=":")
    axes.set_yscale("log")
    axes.set_ylim(*SHOWN_MM)
    picture.log_ticks(axes.yaxis, (1.0,))
    picture.plain(axes, 7)
    axes.set_xticks([row["contact"] for row in next(iter(_by_method(rows).values()))])


def _successes(axes: Axes, rows: Sequence[Row], styles: dict[str, LineStyle]) -> None:
    axes.set_axis_on()
    for name, mine in _by_method(rows).items():
        colour, dashes, width = styles[name]
        x, y = zip(*((row["contact"], row["success_rate"]) for row in mine), strict=True)
        axes.plot(x, y, color=colour, ls=dashes, lw=width, alpha=0.9)
    axes.set_ylim(0.0, 1.02)
    picture.plain(axes, 7)


def _by_method(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(name_of(row), []).append(row)
    return found
