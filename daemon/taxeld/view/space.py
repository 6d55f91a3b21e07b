"""What is seen in three dimensions, beside plots of the same time: the streams as Rerun's entities.

| entity | what it is |
|---|---|
| `world/link`, `world/link/skin`, `world/link/pressed` | the link where the robot says it is, its taxels by activation, those that are pressed |
| `world/object`, `world/modes`, `world/particles`, `world/truth` | the object's slices at the likeliest pose, its outline at each mode, an arrow for each particle, where it truly stands |
| `status/now`, `status/log` | the status and what it rests on; its changes |
| `plot/belief`, `plot/spread`, `plot/error`, `plot/latency` | the heaviest mode's weight; standard deviations; ADD against the truth; time of each stage |
"""  # noqa: E501

import math
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from taxeld.arrays import Floats, Poses
from taxeld.model import se2
from taxeld.stream import messages
from taxeld.view.colour import of_taxels
from taxeld.view.rows import Rows
from taxeld.view.stage import Message, Stage, pose_of

TIME = "scan"  # the time line: Unix time of the measurement
TAXEL_M, PRESSED_M, LINE_M = 0.002, 0.004, 0.0008  # radii
ARROW_M = 0.02
FOUND, MODE, PARTICLE, TRUTH = (230, 60, 60), (70, 150, 255), (130, 180, 230), (240, 240, 240)
LEGENDS = ("spread", "latency")  # of the plots that have several lines
COLOURS = "red: likeliest pose, blue: modes and particles"
EYE_M = (0.065, -0.2, 0.25)  # from what is looked at
ABOVE_M = 0.01  # of the link, beyond the highest and the lowest taxel
SPREADS = {  # name and colour of a plot's line
    "x_mm": ("x [mm]", (255, 120, 90)), "y_mm": ("y [mm]", (110, 200, 120)),
    "yaw_deg": ("yaw [°]", (240, 200, 80)),
}  # fmt: skip
SHOWN_AS = np.array([1e3, 1e3, math.degrees(1.0)])


class Space:
    """The entities of one recording stream."""

    def __init__(self, stage: Stage, stream: rr.RecordingStream, *, is_live: bool) -> None:
        """`is_live`: scans have latencies, as those of a session have not, and none waits to be
        drawn."""
        self._stage, self._stream = stage, stream
        self._rows = Rows(stream, TIME, at_once=is_live)
        self._status: int | None = None
        self._begun = False
        self._seen: dict[str, object] = {}
        self._is_live = is_live
        self._arrange(None)
        self._outline = max((line for _, line in stage.slices), key=len)
        self._middle_m = float(np.mean([height for height, _ in stage.slices]))
        self._draw_what_stays()

    def take(self, message: Message) -> None:
        """One of the streams' maps; those of other topics are left out."""
        topic, m = message
        takes = {
            messages.TAXELS: self._taxels,
            messages.ESTIMATE: self._estimate,
            messages.PARTICLES: self._particles,
        }.get(topic)
        if takes is not None and m["t"]:  # nothing was measured before the first scan
            self._rows.t = m["t"]
            takes(m)

    def flush(self) -> None:
        """Show all that was taken."""
        self._rows.flush()

    def _stays(self, entity: str, thing: Any) -> None:
        self._stream.log(entity, thing, static=True)

    def _is_new(self, entity: str, state: object) -> bool:
        """Whether the entity is not in that state already: to make and send a thing takes far
        longer than to compare, and between touches little changes."""
        if self._seen.get(entity) == state:
            return False
        self._seen[entity] = state
        return True

    def _draw_what_stays(self) -> None:
        stage = self._stage
        position = stage.position_m
        z = position[:, 2]
        self._stays("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        body = rr.Cylinders3D(
            lengths=[float(np.ptp(z)) + 2.0 * ABOVE_M],
            radii=[0.97 * stage.radius_m],
            centers=[[0.0, 0.0, float(z.mean())]],
            colors=[(90, 90, 90)],
            fill_mode="majorwireframe",
        )
        self._stays("world/link/body", body)
        self._stays("world/link/skin", rr.Points3D.from_fields(positions=position, radii=TAXEL_M))
        self._stays("world/link/pressed", rr.Points3D.from_fields(radii=PRESSED_M))
        slices = [_at(line, height) for height, line in stage.slices]
        drawn = rr.LineStrips3D(slices, colors=FOUND, radii=LINE_M)
        self._stays("world/object/slices", drawn)
        self._stays("world/modes", rr.LineStrips3D.from_fields(radii=LINE_M))
        self._stays("world/particles", rr.Arrows3D.from_fields(colors=PARTICLE, radii=LINE_M))
        if stage.truth is not None:
            lines = [_at(se2.apply(stage.truth, line), height) for height, line in stage.slices]
            self._stays("world/truth", rr.LineStrips3D(lines, colors=TRUTH, radii=LINE_M / 2))
        markdown = rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN)
        self._stays("status/now", markdown)
        for name in messages.STAGES:
            self._stays(f"plot/latency/{name}", rr.SeriesLines(names=f"{name} [ms]"))
        for name, (shown, colour) in SPREADS.items():
            self._stays(f"plot/spread/{name}", rr.SeriesLines(names=shown, colors=colour))

    def _taxels(self, m: dict[str, Any]) -> None:
        position = self._stage.position_m
        if len(m["z"]) != len(position):  # of another skin: its info has not come yet
            return
        if m["placed"]:
            self._place("world/link", pose_of(m["sensor"]))
            if not self._begun:  # now it is known where there is something to see
                self._begun = True
                seen = [pose_of(m["sensor"])]
                seen += [] if self._stage.truth is None else [self._stage.truth]
                self._arrange(np.mean(seen, axis=0))
        if not self._is_new("world/link/skin", (m["z"], m["live"])):
            return
        z, live = np.array(m["z"], dtype=float), np.array(m["live"], dtype=bool)
        colours, pressed = of_taxels(z, live), z > 0.0
        self._rows.put("world/link/skin", rr.Points3D, colors=colours)
        self._rows.put("world/link/pressed", rr.Points3D,
                       positions=position[pressed], colors=colours[pressed])  # fmt: skip

    def _estimate(self, e: dict[str, Any]) -> None:
        known = bool(e["valid"])
        self._place("world/object", pose_of(e["map"]) if known else None)
        self._modes(e["modes"] if known else [])
        error_mm = self._stage.error_mm(e)
        self._figures(e, error_mm)
        self._told(e, error_mm)

    def _modes(self, modes: list[dict[str, float]]) -> None:
        """The brighter, the heavier."""
        if not self._is_new("world/modes", modes):
            return
        lines = [_at(se2.apply(pose_of(one), self._outline), self._middle_m) for one in modes]
        colours = [(*MODE, round(255 * max(one["weight"], 0.4))) for one in modes]
        self._rows.put("world/modes", rr.LineStrips3D, strips=lines, colors=colours)

    def _figures(self, e: dict[str, Any], error_mm: float | None) -> None:
        if e["valid"]:
            self._plot("belief/heaviest", e["modes"][0]["weight"])
            sd = np.sqrt(np.maximum(np.diag(np.array(e["cov"], dtype=float)), 0.0))
            for name, value in zip(SPREADS, (sd * SHOWN_AS).tolist(), strict=True):
                self._plot(f"spread/{name}", value)
        if error_mm is not None:
            self._plot("error/add_mm", error_mm)
        if e["lat_us"].get("skin"):
            for name in messages.STAGES:
                self._plot(f"latency/{name}", e["lat_us"].get(name, 0.0) / 1e3)

    def _plot(self, name: str, value: float) -> None:
        self._rows.put(f"plot/{name}", rr.Scalars, scalars=[value])

    def _told(self, e: dict[str, Any], error_mm: float | None) -> None:
        status = self._stage.name("status", e["status"])
        pose = e["map"]
        rows = [
            ("valid", _yes(e["valid"])), ("touching", _yes(e["contact"])),
            ("contacts", e.get("contacts", 0)),
            ("x, y", f"{1e3 * pose['x']:.1f} mm, {1e3 * pose['y']:.1f} mm"),
            ("yaw", f"{math.degrees(pose['theta']):.1f}°"),
            ("modes", " ".join(f"{mode['weight']:.0%}" for mode in e["modes"])),
            ("effective particles", f"{e['ess']:.0f}"),
        ]  # fmt: skip
        if error_mm is not None:
            rows.append(("error (ADD)", f"{error_mm:.1f} mm"))
        text = "\n\n".join([f"# {status}", *(f"**{name}** {value}" for name, value in rows)])
        if self._is_new("status/now", text):
            self._rows.put("status/now", rr.TextDocument, text=[text])
        if e["status"] != self._status:
            self._status = e["status"]
            line = f"{status}, contacts {e.get('contacts', 0)}"
            self._rows.put("status/log", rr.TextLog, text=[line])

    def _particles(self, m: dict[str, Any]) -> None:
        pose = np.array(m["xytheta"], dtype=float).reshape(-1, 3)
        middle = np.array([*self._outline.mean(axis=0), 0.0])
        origin = se2.compose(pose, middle)[:, :2]
        vector = ARROW_M * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        self._rows.put("world/particles", rr.Arrows3D,
                       origins=_at(origin, self._middle_m), vectors=_at(vector, 0.0))  # fmt: skip

    def _arrange(self, look_at: Poses | None) -> None:
        has_errors = self._stage.scene is not None and self._stage.truth is not None
        made = blueprint(errors=has_errors, latencies=self._is_live, look_at=look_at)
        self._stream.send_blueprint(made)

    def _place(self, entity: str, pose: Poses | None) -> None:
        """Move an entity; what has no pose is made too small to be seen."""
        x, y, theta = (0.0, 0.0, 0.0) if pose is None else pose.tolist()
        size = 1e-6 if pose is None else 1.0
        if self._is_new(entity, (x, y, theta, size)):
            turn = (0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta))
            self._rows.put(entity, rr.Transform3D, translation=[(x, y, 0.0)],
                           quaternion=[turn], scale=[[size] * 3])  # fmt: skip


def _yes(flag: bool) -> str:
    return "yes" if flag else "no"


def blueprint(*, errors: bool, latencies: bool, look_at: Poses | None) -> rrb.Blueprint:
    """The scene, with the plots beside it on the same time line; the eye is above a pose."""
    eye = None
    if look_at is not None:
        target = np.array([look_at[0], look_at[1], 0.0])
        eye = rrb.EyeControls3D(position=target + EYE_M, look_target=target)
    lines = [
        ("spread", "spread: 1 standard deviation"), ("belief", "weight of the heaviest mode"),
    ]  # fmt: skip
    lines += [("error", "error: ADD [mm]")] * errors
    lines += [("latency", "latency of a scan, by stage [ms]")] * latencies
    plots = [
        rrb.TimeSeriesView(
            origin=f"/plot/{name}",
            name=title,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=name in LEGENDS),
        )
        for name, title in lines
    ]
    colours = COLOURS + ", white: true pose" * errors
    told = rrb.Tabs(
        rrb.TextDocumentView(origin="/status/now", name="status"),
        rrb.TextLogView(origin="/status/log", name="changes"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/world", name=colours, eye_controls=eye),
            rrb.Vertical(told, *plots, row_shares=[2] + [1] * len(plots)),
            column_shares=[2, 1],
        ),
        rrb.TimePanel(timeline=TIME, play_state="following", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _at(points: Floats, height_m: float) -> Floats:
    """(n, 3) of points (n, 2) at a height."""
    return np.column_stack([points, np.full(len(points), height_m)])
