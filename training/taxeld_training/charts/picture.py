"""Parts of all pictures: colours, legends, axes, and the file."""

from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from PIL import Image

Style = tuple[str, str]  # colour, marker

# Okabe and Ito's colours, for colour-blind readers; grey replaces their yellow, which is too pale
COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#E69F00",
    "#888888",
    "#CC79A7",
    "#000000",
    "#56B4E9",
)
MARKERS = (
    "o",
    "s",
    "^",
    "D",
    "v",
    "P",
    ">",
)  # seven and eight colours: 56 pairs before one repeats
FIRST = (  # names with the same style in every picture
    "density",
    "paper",
    "table",
    "manifold",
    "projection",
)
DPI = 120


def styles(names: Iterable[str]) -> dict[str, Style]:
    """A colour and a marker for each name, in the order of a legend."""
    wanted = set(names)
    order = [*FIRST, *sorted(wanted - set(FIRST))]
    pairs = ((COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]) for i in range(len(order)))
    return {name: pair for name, pair in zip(order, pairs, strict=True) if name in wanted}


def plain(axes: Axes, size: float) -> None:
    """No box, a faint grid, tick labels of `size` points."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=size)
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)


def log_ticks(axis: Axis, multiples: Sequence[float]) -> None:
    """Ticks at these multiples of powers of ten, as plain numbers."""
    axis.set_major_locator(LogLocator(subs=multiples, numticks=20))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def save(figure: Figure, path: Path, palette: bool = False) -> None:
    """Write a picture, with a palette of 256 colours if its many faint lines would compress badly;
    the same figure gives the same bytes."""
    written = BytesIO()
    figure.savefig(written, dpi=DPI, format="png", metadata={"Software": None})
    if palette:
        # Quantised by coverage, rare colours stay.
        image = Image.open(written).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
        written = BytesIO()
        image.save(written, format="png", optimize=True)
    path.write_bytes(written.getvalue())
