"""`taxeld watch`: a daemon's streams as one page of a terminal of 80 by 24 characters."""

import contextlib
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from taxeld.arrays import Floats, Index
from taxeld.commands.unanswered import unanswered
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.stream import messages
from taxeld.view.stage import Stage, from_info
from taxeld.view.streams import Message, Subscriber

REFRESH_S = 0.1
SILENT_S = 2.0  # after this long without a message the page is called old
LOOK_S = 1.0  # pause between two looks why nothing comes
RATE_S = 3.0  # rates are counted over this long
COLUMNS, ROWS, MODES = 24, 8, 5  # at most, of the skin's map; modes shown at most
CELL = 3  # characters a taxel
ALIKE_M, ALIKE_RAD = 0.001, 0.01  # heights of one row and angles of one column differ less
COLOURS = {
    Status.STARTING: "cyan",
    Status.SEARCHING: "cyan",
    Status.AMBIGUOUS: "yellow",
    Status.CONVERGED: "green",
    Status.BLIND: "magenta",
    Status.STALE: "red",
    Status.INCONSISTENT: "red",
}
PLASMA = (  # matplotlib's colour scale, in tenths
    "#0d0887",
    "#46039f",
    "#7201a8",
    "#9c179e",
    "#bd3786",
    "#d8576b",
    "#ed7953",
    "#fb9f3a",
    "#fdca26",
    "#f0f921",
)


def watch(endpoint: str, keys: Path | None, stopping: Callable[[], bool]) -> None:
    """Show the page until `stopping`; waits for a daemon that is not there, or not there any more.

    Raises:
        SetupError: there is no terminal, the endpoint is none, or a stream of another version.
    """
    if not sys.stdout.isatty():
        raise SetupError(
            "watch: needs a terminal to draw on; 'taxeld status' prints lines, and "
            "examples/clients/subscribe.py reads the streams"
        )
    page, looked_s = Page(endpoint), -math.inf
    with (
        contextlib.closing(Subscriber(endpoint, keys)) as streams,
        Live(console=Console(), screen=True, auto_refresh=False) as live,
    ):
        while not stopping():
            end_s = time.monotonic() + REFRESH_S
            while (left_s := end_s - time.monotonic()) > 0.0:
                for message in streams.wait(left_s):
                    page.take(message, time.monotonic())
            now_s = time.monotonic()
            if now_s - page.heard_s > SILENT_S and now_s - looked_s > LOOK_S:
                page.waits, looked_s = unanswered(endpoint), now_s
            live.update(page.render(now_s), refresh=True)


class Page:
    """The last message of each topic, and how it looks. Times are monotonic, in seconds."""

    def __init__(self, endpoint: str) -> None:
        self.waits = ""  # why nothing is heard
        self.heard_s = -math.inf
        self._endpoint = endpoint
        self._object = ""
        self._is_alone = False  # there is no object
        self._map: SkinMap | None = None
        self._last: dict[bytes, dict[str, Any]] = {}
        self._lat_us: dict[str, float] = {}  # latencies of the last scan by stage
        self._seen: dict[bytes, deque[float]] = {}

    def take(self, message: Message, now_s: float) -> None:
        """Keep a message that came at `now_s`."""
        topic, m = message
        if m.get("link"):  # the first link alone is drawn
            return
        if topic == messages.INFO:
            stage = from_info(m)
            named = stage.things[0].name if len(stage.things) == 1 else ""
            self._object, self._map = named, SkinMap(stage)
            self._is_alone = not stage.things
        if topic == messages.ESTIMATE and m["lat_us"].get("skin"):
            self._lat_us = m["lat_us"]
        self._last[topic], self.heard_s = m, now_s
        self._seen.setdefault(topic, deque(maxlen=1000)).append(now_s)

    def render(self, now_s: float) -> Group:
        lines = [self._title(now_s)]
        if self._map is not None:
            lines += self._map.lines(self._last.get(messages.TAXELS))
        if self._is_alone:
            lines += [
                *self._touches(),
                _row("rates", f"{self._hz(messages.TAXELS, now_s):.1f} scans/s"),
            ]
        if messages.ESTIMATE in self._last:
            lines += [*_belief(self._last[messages.ESTIMATE]), *self._running(now_s)]
        return Group(*lines)

    def _title(self, now_s: float) -> Text:
        named = self._object or messages.object_of(self._last.get(messages.ESTIMATE, {}))
        text = Text("taxeld ", style="bold").append(f"{named}  " if named else "", "default")
        if not self._last:
            return text.append(f"waiting: {self.waits or self._endpoint}", style="yellow")
        silent_s = now_s - self.heard_s
        if silent_s > SILENT_S:
            return text.append(f"nothing for {silent_s:.0f} s: {self.waits}", style="red")
        return text.append(self._endpoint, style="dim")

    def _hz(self, topic: bytes, now_s: float) -> float:
        """Messages of a topic a second, of late."""
        return sum(now_s - s <= RATE_S for s in self._seen.get(topic, ())) / RATE_S

    def _touches(self) -> list[Text]:
        """A line for each of the strongest patches of touch."""
        lines = [Text("patch    x [mm]    y [mm]    z [mm]  taxels   depth [mm]", style="dim")]
        for one in self._last.get(messages.CONTACTS, {"patches": []})["patches"][:MODES]:
            x, y, z = (1e3 * one["world_position"][axis] for axis in "xyz")
            row = f"{one['id']:5d} {x:9.1f} {y:9.1f} {z:9.1f} {one['taxels']:7d}"
            lines.append(Text(f"{row} {1e3 * one['depth_m']:12.2f}"))
        return lines if len(lines) > 1 else [*lines, Text("nothing is touched", style="dim")]

    def _running(self, now_s: float) -> list[Text]:
        e, health = self._last[messages.ESTIMATE], self._last.get(messages.HEALTH)
        scans, estimates = (
            self._hz(topic, now_s) for topic in (messages.TAXELS, messages.ESTIMATE)
        )
        rates = _row("rates", f"{scans:.1f} scans/s, {estimates:.1f} estimates/s")
        age = _row("age", f"{e['age_us'] / 1e3:.1f} ms since the scan")
        if health is None:
            return [rates, age, _row("health", "not heard yet; it comes once a second")]
        inputs = health["inputs"]
        old_s = inputs.get("poses_age_s", -1.0)  # negative while no pose came
        pose = "without sensor poses" if old_s < 0.0 else f"sensor pose {1e3 * old_s:.0f} ms old"
        age.append(f", {pose}")
        p99_ms = health["lat_us"]["total"]["p99"] / 1e3
        dropped = sum(health["source"].get("dropped", {}).values())
        counts = f"{health['loop']['overruns']} overruns, {dropped} frames dropped, "
        return [
            rates,
            age,
            _row("latency", "".join(f"{stage:>10s}" for stage in messages.STAGES) + "   [ms]"),
            _row("  now", _in_ms(self._lat_us, messages.STAGES)),
            _row("  99 %", f"{p99_ms:{10 * len(messages.STAGES)}.2f}"),
            _row("health", counts + f"{len(health['dead_taxels'])} dead taxels"),
            *(
                _row(name, messages.reason_of(link["why"]))
                for name, link in health.get("links", {}).items()
                if link["why"]
            ),
        ]


class SkinMap:
    """Where each taxel stands on the unrolled skin, in rows and columns of characters."""

    def __init__(self, stage: Stage) -> None:
        x, y, z = stage.position_m.T
        self._column, columns = _places(np.arctan2(y, x) % (2.0 * np.pi), ALIKE_RAD, COLUMNS)
        row, rows = _places(z, ALIKE_M, ROWS)
        self._row = rows - 1 - row  # the highest taxels are the top row
        self._shape = rows, columns
        self._edges = {rows - 1: f"{1e3 * z.min():+.0f}mm", 0: f"{1e3 * z.max():+.0f}mm"}

    def lines(self, taxels: dict[str, Any] | None) -> list[Text]:
        """A line a row; a digit is tenths of full scale, `·` not pressed, `x` dead."""
        z, live = np.full(self._shape, -1.0), np.zeros(self._shape, dtype=bool)
        if taxels is not None and len(taxels["z"]) == len(self._row):
            np.maximum.at(z, (self._row, self._column), np.array(taxels["z"], dtype=float))
            np.logical_or.at(live, (self._row, self._column), np.array(taxels["live"], dtype=bool))
        lines = []
        for r, (row, lives) in enumerate(zip(z.tolist(), live.tolist(), strict=True)):
            cells = [_cell(*one) for one in zip(row, lives, strict=True)]
            lines.append(Text(f"{self._edges.get(r, ''):>5s} ", style="dim").append_tokens(cells))
        under = " " * 6 + f"{'0°':<{self._shape[1] * CELL // 2}s}180°"
        return [*lines, Text(under + "   0..9: tenths of full scale", style="dim")]


def _belief(e: dict[str, Any]) -> list[Text]:
    touch = "touching" if e["contact"] else "not touching"
    head = Text("status  ", style="dim")
    colour = COLOURS.get(e["status"], "default")
    head.append(messages.name_of(Status, e["status"]).upper(), style=f"bold {colour}")
    head.append(f", {'valid' if e['valid'] else 'not valid'}, {touch}, ")
    head.append(f"{e['contacts']} contacts, p {e['p']:.1%}")
    lines = [head, Text("mode     x [mm]    y [mm]   yaw [°]  weight", style="dim")]
    for number, mode in enumerate(e["modes"][:MODES], 1):
        x_mm, y_mm, yaw = 1e3 * mode["x"], 1e3 * mode["y"], math.degrees(mode["theta"])
        row = f"{number:4d} {x_mm:10.1f}{y_mm:10.1f}{yaw:10.1f}{mode['weight']:8.0%}  "
        lines.append(Text(row).append("█" * round(20 * mode["weight"]), "blue"))
    lines += [Text("")] * (MODES - len(e["modes"]))  # the lines below stay where they are
    x, y, yaw = (math.sqrt(max(e["cov"][k][k], 0.0)) for k in range(3))
    spread = f"{1e3 * x:.1f} mm, {1e3 * y:.1f} mm, {math.degrees(yaw):.1f}° (1 sd)"
    if not e["valid"]:
        return [*lines, _row("why not", messages.reason_of(e["why"]))]
    return [*lines, _row("radius", f"{1e3 * e['radius_m']:.1f} mm; all particles {spread}")]


def _places(values: Floats, alike: float, most: int) -> tuple[Index, int]:
    """(n,) the place of each of `values` (n,), and the number of places: one for values that are
    alike; `most` even parts where these would be more."""
    order = np.argsort(values)
    steps = np.diff(values[order], prepend=values[order[0]]) > alike
    place = np.empty(len(values), dtype=np.intp)
    place[order] = np.cumsum(steps)
    if place.max() < most:
        return place, int(place.max()) + 1
    share = (values - values.min()) / np.ptp(values)
    return np.minimum((share * most).astype(np.intp), most - 1), most


def _cell(z: float, live: bool) -> tuple[str, str]:
    """Text and style of a place with activation z; negative where no taxel stands."""
    if z < 0.0:
        return " " * CELL, ""
    if not live:
        return f"{'x':^{CELL}s}", "red"
    if z == 0.0:
        return f"{'·':^{CELL}s}", "dim"
    tenths = min(int(10 * z), 9)
    ink = "black" if z > 0.5 else "white"
    return f"{tenths:^{CELL}d}", f"{ink} on {PLASMA[tenths]}"


def _row(name: str, text: str) -> Text:
    made = Text(f"{name:8s}", style="dim", no_wrap=True, overflow="ellipsis")
    return made.append(text, "default")


def _in_ms(us: dict[str, float], stages: Iterable[str]) -> str:
    return "".join(f"{us.get(stage, 0.0) / 1e3:10.2f}" for stage in stages)
