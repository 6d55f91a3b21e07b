"""The picture of `taxeld-hil physics --curves`: simulated skins beside the recordings' bands."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from taxeld.arrays import Floats
from taxeld_hil.experiment import curves
from taxeld_hil.experiment.curves import AFTER_S, APART_M, BANDS, LEVELS, Curves

COLOURS = ("#0072B2", "#D55E00", "#009E73")  # Okabe and Ito's: a skin each
BAND = {"median": "0.45", "p90": "0.7"}
SHARE = {"median": 0.5, "p90": 0.9}
PATCHES = ((0.5, 0.6, 0.1), (13.0, 45.0, 0.5), (85.0, 95.0, 0.9))  # noise, and where it is drawn
DPI = 100


def draw(skins: dict[str, Curves], path: Path) -> None:
    """`skins`: by name."""
    figure = Figure(figsize=(11.0, 6.6), layout="constrained")
    panels = figure.subplots(2, 3)
    colour = dict(zip(skins, COLOURS, strict=False))
    for axes in panels.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.grid(color="0.92", lw=0.6)
        axes.set_axisbelow(True)
    after, beside, response, loop, coupled, noise = panels.flat
    for name, each in skins.items():
        _quantiles(after, np.array(AFTER_S), 100.0 * each.residue, colour[name])
        _quantiles(beside, 1e3 * APART_M, 100.0 * each.sag, colour[name])
        _response(response, each, colour[name])
        _under(loop, 100.0 * curves.widest(each), colour[name])
        _under(coupled, 100.0 * each.cross_talk, colour[name])
        _under(noise, each.noise_counts, colour[name])
    for band in BANDS:
        if band.name in ("residue", "sag"):
            axes, at = (after, band.at) if band.name == "residue" else (beside, 1e3 * band.at)
            _band(axes, [at, at], [max(band.low, 0.02), band.high], band.quantile)
        if band.name in ("hysteresis", "cross-talk") and band.quantile != "mean":
            axes, share = loop if band.name == "hysteresis" else coupled, SHARE[band.quantile]
            _band(axes, [max(band.low, 0.02), band.high], [share, share], band.quantile)
    for low, high, share in PATCHES:
        _band(noise, [low, high], [share, share], "median")
    for axes in (after, beside):
        axes.set_yscale("log")
    after.set_ylim(0.05, 20.0)
    beside.set_ylim(0.02, 120.0)
    for axes, limits in ((coupled, (0.05, 50.0)), (noise, (0.3, 150.0))):
        axes.set_xscale("log")
        axes.set_xlim(*limits)
    _name(after, "After a press of 1 s", "s after the release", "% of the peak")
    _name(beside, "Beside a fingertip, 2 mm deep", "mm from the taxel", "% of its peak")
    _name(response, "Response, and where 8 of 10 taxels lie", "share of full pressure",
          "share of full reading")  # fmt: skip
    _name(loop, "Widest point of the loop", "% of full", "share of taxels")
    _name(coupled, "Cross-talk", "% of the module's peak", "share of pairs")
    _name(noise, "Noise (flat patch, handle, large patch)", "counts", "share of taxels")
    handles = [Line2D([], [], color=c, lw=2, label=name) for name, c in colour.items()]
    handles += [
        Line2D([], [], color=BAND["median"], lw=5, alpha=0.6, label="recordings: median"),
        Line2D([], [], color=BAND["p90"], lw=5, alpha=0.6, label="recordings: 90th percentile"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    figure.savefig(path, dpi=DPI, metadata={"Software": None})


def _quantiles(axes: Axes, x: Floats, values: Floats, colour: str) -> None:
    """Median, and dashed the 90th percentile, of values (n, len(x))."""
    for quantile, dashes in zip(np.quantile(values, (0.5, 0.9), axis=0), ("-", "--"), strict=True):
        axes.plot(x, np.maximum(quantile, 1e-3), dashes, color=colour, lw=1.6)


def _response(axes: Axes, each: Curves, colour: str) -> None:
    full = each.up[:, -1:]
    low, median, high = np.quantile(each.up / full, (0.1, 0.5, 0.9), axis=0)
    axes.fill_between(LEVELS, low, high, color=colour, alpha=0.15, lw=0)
    axes.plot(LEVELS, median, color=colour, lw=1.4)


def _under(axes: Axes, values: Floats, colour: str) -> None:
    """The share of values below x."""
    share = np.linspace(0.0, 1.0, 401)
    axes.plot(np.maximum(np.quantile(values, share), 1e-3), share, color=colour, lw=1.6)


def _band(axes: Axes, x: list[float], y: list[float], quantile: str) -> None:
    axes.plot(x, y, color=BAND[quantile], lw=5, alpha=0.6, solid_capstyle="butt")


def _name(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
