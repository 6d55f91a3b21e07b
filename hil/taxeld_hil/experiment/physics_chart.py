"""The picture of `taxeld-hil physics`."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from taxeld_hil.experiment.physics_gap import STAGES

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#888888")  # Okabe and Ito's: an object each
DPI = 110


def draw(result: dict[str, Any], path: Path) -> None:
    """`result`: as `experiment` writes it."""
    figure = Figure(figsize=(13.0, 4.4), layout="constrained")
    panels = figure.subplots(1, 3)
    colour = dict(zip(result["gap"], COLOURS, strict=False))
    for axes in panels.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.grid(color="0.92", lw=0.6)
        axes.set_axisbelow(True)
    _effects(panels[0], result, colour)
    _readings(panels[1], result, colour)
    _depths(panels[2], result, colour)
    handles = [Line2D([], [], color=c, lw=2, label=name) for name, c in colour.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    figure.savefig(path, dpi=DPI, metadata={"Software": None})


def _effects(axes: Axes, result: dict[str, Any], colour: dict[str, str]) -> None:
    at = np.arange(len(STAGES))
    for k, (name, gap) in enumerate(result["gap"].items()):
        own = [stage["step_rms"] for stage in gap["stages"]]
        total = [stage["rms"] for stage in gap["stages"]]
        axes.barh(at + 0.35 * (k - 0.5), own, 0.32, color=colour[name])
        axes.plot(total, at + 0.35 * (k - 0.5), "k|", ms=9, mew=1.6)
    axes.set_yticks(at, STAGES)
    axes.invert_yaxis()
    axes.axvline(result["plan"]["noise_sigma"], color="0.4", ls="--", lw=1)
    axes.set_xlabel("rms change of an activation; bar: this effect, tick: all so far; dashed σ",
                    fontsize=8)  # fmt: skip
    axes.set_title("What parts the two models", fontsize=10)


def _readings(axes: Axes, result: dict[str, Any], colour: dict[str, str]) -> None:
    h = np.linspace(0.0, 1.0, 100)
    noise = next(iter(result["gap"].values()))["noise"]["assumed"]
    sd = np.hypot(noise["sigma"], noise["gain_cv"] * h)
    axes.fill_between(h, h - 1.645 * sd, h + 1.645 * sd, color="0.88", lw=0)
    axes.plot(h, h, color="0.6", lw=1)
    for k, (name, gap) in enumerate(result["gap"].items()):
        rows = gap["read_by_expected"]
        x = np.array([row["expected"] for row in rows]) + 0.012 * (k - 0.5)
        median = np.array([row["median"] for row in rows])
        ends = np.array([[row["q05"] for row in rows], [row["q95"] for row in rows]])
        axes.errorbar(x, median, np.abs(ends - median), fmt="o", ms=4, lw=1.2, color=colour[name])
    axes.set_ylim(-0.05, 1.05)
    axes.set_xlabel("expected activation h", fontsize=8)
    axes.set_ylabel("read", fontsize=8)
    axes.set_title("Nine in ten readings (grey: what the estimator allows for)", fontsize=10)


def _depths(axes: Axes, result: dict[str, Any], colour: dict[str, str]) -> None:
    marks = {STAGES[0]: ":", STAGES[2]: "--", STAGES[4]: "-.", STAGES[-1]: "-"}
    for name, gap in result["gap"].items():
        rows = gap["rms_by_depth"]
        middle = [np.mean(row["depth_mm"]) for row in rows]
        for stage, dashes in marks.items():
            axes.plot(middle, [row[stage] for row in rows], dashes, color=colour[name], lw=1.4)
    handles = [Line2D([], [], color="0.3", ls=d, label=f"to {stage}") for stage, d in marks.items()]
    axes.legend(handles=handles, fontsize=8, frameon=False)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("depth of the press [mm]", fontsize=8)
    axes.set_ylabel("rms difference of an activation", fontsize=8)
    axes.set_title("By depth", fontsize=10)
