"""A page for a terminal of 80 by 24 characters: the skin, the status, the modes, how it runs."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group
from rich.style import Style
from rich.text import Text

from taxeld.arrays import Floats
from taxeld.estimator.estimate import Status
from taxeld.stream import messages
from taxeld.view.colour import plasma
from taxeld.view.stage import Message, Stage, from_info

COLUMNS, ROWS, MODES = 24, 8, 5  # of the skin's map, and modes shown
CELL = 3  # characters a taxel
RATE_S = 3.0  # over which rates are counted
SILENT_S = 2.0  # after which what is shown is called old
ALIKE_M, ALIKE_RAD = 0.001, 0.01  # taxels so near in height or angle stand in one row or column
COLOURS = {
    Status.CONVERGED: "green", Status.AMBIGUOUS: "yellow", Status.SEARCHING: "cyan",
    Status.STARTING: "cyan", Status.BLIND: "magenta", Status.STALE: "red",
    Status.INCONSISTENT: "red",
}  # fmt: skip


@dataclass
class Page:
    """What was heard, and how it looks. Times are those of the viewer's monotonic clock."""

    endpoint: str
    waits: str = ""  # why nothing was heard yet
    stage: Stage | None = None
    last: dict[bytes, dict[str, Any]] = field(default_factory=dict)
    lat_us: dict[str, float] = field(default_factory=dict)  # of the last scan
    heard_s: float = -math.inf
    _seen: dict[bytes, deque[float]] = field(default_factory=dict)
    _map: "SkinMap | None" = None

    def take(self, message: Message, now_s: float) -> None:
        """Raises SetupError for an info that is none."""
        topic, m = message
        if topic == messages.INFO:
            self.stage = from_info(m)
            self._map = SkinMap(self.stage)
        if topic == messages.ESTIMATE and m["lat_us"].get("skin"):
            self.lat_us = m["lat_us"]
        self.last[topic], self.heard_s = m, now_s
        self._seen.setdefault(topic, deque(maxlen=1000)).append(now_s)

    def render(self, now_s: float) -> Group:
        lines = [self._title(now_s)]
        if self.stage is not None and self._map is not None:
            lines += self._map.lines(self.last.get(messages.TAXELS))
        if messages.ESTIMATE in self.last:
            lines += self._belief(self.last[messages.ESTIMATE])
            lines += self._running(now_s)
        return Group(*lines)

    def _title(self, now_s: float) -> Text:
        text = Text("taxeld ", style="bold")
        if self.stage is not None:
            text.append(f"{self.stage.object}  ", style="default")
        if not self.last:
            return text.append(f"waiting: {self.waits or self.endpoint}", style="yellow")
        silent_s = now_s - self.heard_s
        if silent_s > SILENT_S:
            return text.append(f"nothing for {silent_s:.0f} s: {self.waits}", style="red")
        return text.append(self.endpoint, style="dim")

    def _belief(self, e: dict[str, Any]) -> list[Text]:
        name = self.stage.name("status", e["status"]) if self.stage else str(e["status"])
        colour = COLOURS.get(e["status"], "default")
        touch = "touching" if e["contact"] else "not touching"
        head = Text("status  ", style="dim")
        head.append(name.upper(), style=f"bold {colour}")
        head.append(f", {'valid' if e['valid'] else 'not valid'}, {touch}, ")
        head.append(f"{e.get('contacts', 0)} contacts, {e['ess']:.0f} effective particles")
        lines = [head, Text("mode     x [mm]    y [mm]   yaw [°]  weight", style="dim")]
        for number, mode in enumerate(e["modes"][:MODES], 1):
            share = mode["weight"]
            bar = "█" * round(20 * share)
            lines.append(
                Text(f"{number:4d} {1e3 * mode['x']:10.1f}{1e3 * mode['y']:10.1f}"
                     f"{math.degrees(mode['theta']):10.1f}{share:8.0%}  ").append(bar, "blue")
            )  # fmt: skip
        lines += [Text("")] * (MODES - len(e["modes"]))  # what stands below stays where it is
        x, y, yaw = (math.sqrt(max(e["cov"][k][k], 0.0)) for k in range(3))
        spread = f"{1e3 * x:.1f} mm, {1e3 * y:.1f} mm, {math.degrees(yaw):.1f}°"
        return [*lines, _row("spread", f"{spread} (1 sd of all particles)")]

    def _running(self, now_s: float) -> list[Text]:
        scans = self._rate(messages.TAXELS, now_s)
        estimates = self._rate(messages.ESTIMATE, now_s)
        e, health = self.last[messages.ESTIMATE], self.last.get(messages.HEALTH)
        rows = [
            _row("rates", f"{scans:.1f} scans/s, {estimates:.1f} estimates/s"),
            _row("age", f"{e['age_us'] / 1e3:.1f} ms since the scan"),
        ]
        if health is None:
            return [*rows, _row("health", "not heard yet; it comes once a second")]
        inputs, source = health["inputs"], health["source"]
        old_s = inputs.get("poses_age_s", -1.0)  # as the daemon says where none came
        pose = "without sensor poses" if old_s < 0.0 else f"sensor pose {1e3 * old_s:.0f} ms old"
        stale = [kind for kind in ("scans", "poses") if inputs.get(f"{kind}_stale")]
        rows[-1].append(f", {pose}" + (f"; STALE {', '.join(stale)}" if stale else ""))
        stages = [s for s in messages.STAGES if s in health["lat_us"]]
        rows += [
            _row("latency", "".join(f"{stage:>10s}" for stage in stages) + "   [ms]"),
            _row("  now", _figures(self.lat_us, stages)),
            _row("  99 %", _figures({s: health["lat_us"][s]["p99"] for s in stages}, stages)),
        ]
        dropped = sum(source.get("dropped", {}).values())
        dead = len(health["dead_taxels"])
        more = (
            f"{health['loop']['overruns']} overruns, {dropped} frames dropped, {dead} dead taxels"
        )
        return [*rows, _row("health", more)]

    def _rate(self, topic: bytes, now_s: float) -> float:
        return sum(now_s - s <= RATE_S for s in self._seen.get(topic, ())) / RATE_S


class SkinMap:
    """Where each taxel stands on the unrolled skin, in rows and columns of characters."""

    def __init__(self, stage: Stage) -> None:
        x, y, z = stage.position_m.T
        self._column, columns = _places(np.arctan2(y, x) % (2.0 * np.pi), ALIKE_RAD, COLUMNS)
        row, rows = _places(z, ALIKE_M, ROWS)
        self._row = rows - 1 - row  # the highest above
        self._shape = rows, columns
        self._low_mm, self._high_mm = 1e3 * z.min(), 1e3 * z.max()

    def lines(self, taxels: dict[str, Any] | None) -> list[Text]:
        """A line a row; a digit is tenths of full scale, `·` not pressed, `x` dead."""
        rows, columns = self._shape
        z, live = np.full(self._shape, -1.0), np.zeros(self._shape, dtype=bool)
        if taxels is not None and len(taxels["z"]) == len(self._row):
            np.maximum.at(z, (self._row, self._column), np.array(taxels["z"], dtype=float))
            np.logical_or.at(live, (self._row, self._column), np.array(taxels["live"], dtype=bool))
        lines = []
        for r in range(rows):
            edge = {0: f"{self._high_mm:+.0f}mm", rows - 1: f"{self._low_mm:+.0f}mm"}.get(r, "")
            text = Text(f"{edge:>5s} ", style="dim")
            for c in range(columns):
                text.append(*_cell(float(z[r, c]), bool(live[r, c])))
            lines.append(text)
        under = " " * 6 + f"{'0°':<{columns * CELL // 2}s}180°"
        return [*lines, Text(under + "   0..9: tenths of full scale", style="dim")]


def _places(values: Floats, alike: float, most: int) -> tuple[NDArray[np.intp], int]:
    """The place of each of the values: one for those alike, or, where these are too many, one of
    `most` even parts; and how many places there are."""
    order = np.argsort(values)
    steps = np.diff(values[order], prepend=values[order[0]]) > alike
    place = np.empty(len(values), dtype=np.intp)
    place[order] = np.cumsum(steps)
    if place.max() < most:
        return place, int(place.max()) + 1
    share = (values - values.min()) / np.ptp(values)
    return np.minimum((share * most).astype(np.intp), most - 1), most


def _cell(z: float, live: bool) -> tuple[str, Style]:
    if z < 0.0:  # no taxel stands there, or nothing was heard
        return " " * CELL, Style()
    if not live:
        return f"{'x':^{CELL}s}", Style(color="red")
    if z == 0.0:
        return f"{'·':^{CELL}s}", Style(dim=True)
    r, g, b = plasma(np.array([z]))[0]
    ink = "black" if z > 0.5 else "white"
    return f"{min(int(10 * z), 9):^{CELL}d}", Style.parse(f"{ink} on rgb({r},{g},{b})")


def _row(name: str, text: str) -> Text:
    return Text(f"{name:8s}", style="dim", no_wrap=True, overflow="ellipsis").append(
        text, "default"
    )


def _figures(us: dict[str, float], stages: list[str]) -> str:
    return "".join(f"{us.get(stage, 0.0) / 1e3:10.2f}" for stage in stages)
