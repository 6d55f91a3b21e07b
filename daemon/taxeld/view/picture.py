"""The streams as Rerun's entities, in three dimensions and as plots of the same time.

| entity | shows |
|---|---|
| `world/link`, `world/link/skin` | the link where the robot says it is, its taxels by activation |
| `world/object`, `world/truth` | the object's slices at the likeliest pose, and at the true one |
| `world/modes`, `world/particles` | the outline at each mode, an arrow for each particle |
| `world/radius` | a ring of `radius_m` about the middle of the object at the likeliest pose |
| `status/now`, `status/log` | the status with what it rests on, and its changes |
| `plot/belief`, `plot/spread` | `p` and the hypotheses, standard deviations |
| `plot/error`, `plot/latency` | ADD against the truth, the time of each stage |
"""

import math
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from contourpy import contour_generator
from matplotlib import colormaps
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Poses
from taxeld.commands.status import estimate_rows
from taxeld.estimator.estimate import Status
from taxeld.model import se2
from taxeld.stream import messages
from taxeld.view.stage import Stage, Thing, pose_of

TIME = "scan"  # the time line: Unix time of the measurement
TAXEL_M, PRESSED_M, LINE_M = 0.002, 0.004, 0.0008  # radii of points and lines
ARROW_M = 0.02  # length of a particle's arrow
ABOVE_M = 0.01  # the link is drawn so far beyond the highest and the lowest taxel
EYE_M = (0.065, -0.2, 0.25)  # position of the eye from the point that it looks at
FOUND, MODE, PARTICLE, TRUTH = (230, 60, 60), (70, 150, 255), (130, 180, 230), (240, 240, 240)
LINK, QUIET, DEAD = (90, 90, 90), (120, 120, 120), (200, 30, 30)
LEAST = 0.25  # beginning on the colour scale: darker colours do not show on black
SPREADS = {"x [mm]": (255, 120, 90), "y [mm]": (110, 200, 120), "yaw [°]": (240, 200, 80)}
BELIEFS = {"p": FOUND, "stands": (110, 200, 120), "moved": (240, 200, 80), "other": (150, 150, 150)}
PER_UNIT = np.array([1e3, 1e3, math.degrees(1.0)])  # mm and degrees in m and rad
ANGLES = np.linspace(0.0, 2.0 * np.pi, 61)
CIRCLE = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])


class Picture:
    """The entities of one recording stream."""

    def __init__(self, stage: Stage, stream: rr.RecordingStream) -> None:
        self._stage, self._stream = stage, stream
        self._status: int | None = None
        self._text = ""  # the words on the last estimate
        self._felt: object = None  # the activations that were drawn last
        self._is_placed = False
        self._shown = 0  # number of the object that is drawn
        self._slices = [slices_of(stage, thing) for thing in stage.things]
        self._outlines = [max((line[:, :2] for line in own), key=len) for own in self._slices]
        self._middle_m = float(
            np.mean([line[0, 2] for own in self._slices[:1] for line in own] or 0.0)
        )
        self._arrange(None)
        self._draw_still()

    def take(self, topic: bytes, m: dict[str, Any]) -> None:
        """Draw one of the streams' maps; those of other topics are left out."""
        takes = {
            messages.TAXELS: self._taxels,
            messages.ESTIMATE: self._estimate,
            messages.PARTICLES: self._particles,
        }.get(topic)
        if takes is not None and m["t"]:  # nothing was measured before the first scan
            self._stream.set_time(TIME, timestamp=m["t"])
            takes(m)

    def _draw_still(self) -> None:
        stage, z = self._stage, self._stage.position_m[:, 2]
        still = {
            "world": rr.ViewCoordinates.RIGHT_HAND_Z_UP,
            "world/link/body": rr.Cylinders3D(
                lengths=[float(np.ptp(z)) + 2.0 * ABOVE_M],
                radii=[0.97 * stage.radius_m],
                centers=[[0.0, 0.0, float(z.mean())]],
                colors=[LINK],
                fill_mode="majorwireframe",
            ),
            "world/link/skin": rr.Points3D.from_fields(positions=stage.position_m),
            "world/modes": rr.LineStrips3D.from_fields(radii=LINE_M),
            "world/radius": rr.LineStrips3D.from_fields(colors=FOUND, radii=LINE_M / 2),
            "world/particles": rr.Arrows3D.from_fields(colors=PARTICLE, radii=LINE_M),
            "status/now": rr.TextDocument.from_fields(media_type=rr.MediaType.MARKDOWN),
            "plot/belief": rr.SeriesLines(names=list(BELIEFS), colors=list(BELIEFS.values())),
            "plot/spread": rr.SeriesLines(names=list(SPREADS), colors=list(SPREADS.values())),
            "plot/latency": rr.SeriesLines(names=[f"{stage} [ms]" for stage in messages.STAGES]),
        }
        if stage.truth is not None and self._slices:
            lines = [
                _at(se2.apply(stage.truth, line[:, :2]), line[0, 2]) for line in self._slices[0]
            ]
            still["world/truth"] = rr.LineStrips3D(lines, colors=TRUTH, radii=LINE_M / 2)
        for entity, thing in still.items():
            self._stream.log(entity, thing, static=True)
        if self._slices:
            self._draw_object(0)

    def _draw_object(self, number: int) -> None:
        """Draw the object of this number where the last one was."""
        self._shown = number
        drawn = rr.LineStrips3D(self._slices[number], colors=FOUND, radii=LINE_M)
        self._stream.log("world/object/slices", drawn, static=len(self._slices) == 1)

    def _taxels(self, m: dict[str, Any]) -> None:
        # of a further link, or the daemon got another skin
        if m.get("link") or len(m["z"]) != len(self._stage.position_m):
            return
        if m["placed"]:
            self._place("world/link", pose_of(m["sensor"]))
            if not self._is_placed:  # the eye can be placed now
                self._is_placed = True
                seen = [pose_of(m["sensor"])]
                seen += [] if self._stage.truth is None else [self._stage.truth]
                self._arrange(np.mean(seen, axis=0))
        if self._felt == (m["z"], m["live"]):  # true of most scans
            return
        self._felt = m["z"], m["live"]
        z, live = np.array(m["z"], dtype=float), np.array(m["live"], dtype=bool)
        radii = np.where(z > 0.0, PRESSED_M, TAXEL_M)
        drawn = rr.Points3D.from_fields(colors=colours_of(z, live), radii=radii)
        self._stream.log("world/link/skin", drawn)

    def _estimate(self, e: dict[str, Any]) -> None:
        valid, modes = bool(e["valid"]), e["modes"] if e["valid"] else []
        error_mm = self._stage.error_mm(e)
        if e["object"] != self._shown:
            self._draw_object(e["object"])
        self._place("world/object", pose_of(e["map"]) if valid else None)
        lines = [
            _at(se2.apply(pose_of(one), self._outlines[one["object"]]), self._middle_m)
            for one in modes
        ]
        colours = [(*MODE, round(255 * max(one["weight"], 0.4))) for one in modes]
        self._stream.log("world/modes", rr.LineStrips3D.from_fields(strips=lines, colors=colours))
        middle = se2.apply(pose_of(e["map"]), self._middle[None])
        rings = [_at(middle + e["radius_m"] * CIRCLE, self._middle_m)] if valid else []
        self._stream.log("world/radius", rr.LineStrips3D.from_fields(strips=rings))
        self._say(e, error_mm)
        if valid:
            sd = np.sqrt(np.maximum(np.diag(np.array(e["cov"], dtype=float)), 0.0))
            likely = {"p": e["p"], **e["hypotheses"]}
            self._stream.log("plot/belief", rr.Scalars([likely[name] for name in BELIEFS]))
            self._stream.log("plot/spread", rr.Scalars(sd * PER_UNIT))
        if error_mm is not None:
            self._stream.log("plot/error", rr.Scalars(error_mm))
        if e["lat_us"].get("skin"):
            took_ms = [e["lat_us"].get(name, 0.0) / 1e3 for name in messages.STAGES]
            self._stream.log("plot/latency", rr.Scalars(took_ms))

    def _say(self, e: dict[str, Any], error_mm: float | None) -> None:
        rows = [f"**{name}** {text}" for name, text in estimate_rows(e)]
        rows += [] if error_mm is None else [f"**Error (ADD)** {error_mm:.1f} mm"]
        text = "\n\n".join(rows)
        if text != self._text:
            self._text = text
            self._stream.log("status/now", rr.TextDocument.from_fields(text=text))
        if e["status"] != self._status:
            self._status = e["status"]
            line = f"{messages.name_of(Status, e['status'])}, contacts {e['contacts']}"
            self._stream.log("status/log", rr.TextLog(line))

    def _particles(self, m: dict[str, Any]) -> None:
        pose = np.array(m["xytheta"], dtype=float).reshape(-1, 3)
        origin = se2.compose(pose, np.array([*self._middle, 0.0]))[:, :2]
        vector = ARROW_M * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        at, to = _at(origin, self._middle_m), _at(vector, 0.0)
        self._stream.log("world/particles", rr.Arrows3D.from_fields(origins=at, vectors=to))

    @property
    def _middle(self) -> Floats:
        """(2,) of the object that is drawn, in its own frame."""
        return np.asarray(self._outlines[self._shown].mean(axis=0))

    def _place(self, entity: str, pose: Poses | None) -> None:
        """Move an entity to a pose (3,); one without a pose is made too small to be seen."""
        x, y, theta = (0.0, 0.0, 0.0) if pose is None else pose.tolist()
        moved = rr.Transform3D(
            translation=(x, y, 0.0),
            quaternion=(0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta)),
            scale=1e-6 if pose is None else 1.0,
        )
        self._stream.log(entity, moved)

    def _arrange(self, look_at: Poses | None) -> None:
        """The scene with the plots beside it; the eye is above the pose `look_at` (3,)."""
        eye = None
        if look_at is not None:
            target = np.array([look_at[0], look_at[1], 0.0])
            eye = rrb.EyeControls3D(position=target + EYE_M, look_target=target)
        known = [thing.scene for thing in self._stage.things[:1]]
        has_errors = known not in ([], [None]) and self._stage.truth is not None
        plots = {"spread": "spread: 1 standard deviation", "belief": "p and the hypotheses"}
        if has_errors:
            plots["error"] = "error: ADD [mm]"
        if self._stage.is_live:
            plots["latency"] = "latency of a scan, by stage [ms]"
        views = [
            rrb.TimeSeriesView(origin=f"/plot/{name}", name=title) for name, title in plots.items()
        ]
        words = rrb.Tabs(
            rrb.TextDocumentView(origin="/status/now", name="status"),
            rrb.TextLogView(origin="/status/log", name="changes"),
        )
        colours = "red: likeliest pose and radius, blue: modes and particles"
        colours += ", white: true pose" * has_errors
        scene = rrb.Spatial3DView(origin="/world", name=colours, eye_controls=eye)
        beside = rrb.Vertical(words, *views, row_shares=[2] + [1] * len(views))
        time = rrb.TimePanel(timeline=TIME, play_state="following", state="collapsed")
        both = rrb.Horizontal(scene, beside, column_shares=[2, 1])
        self._stream.send_blueprint(rrb.Blueprint(both, time, collapse_panels=True))


def slices_of(stage: Stage, thing: Thing) -> list[Floats]:
    """Closed lines (P, 3) on an object at the heights of the scene's grids; without a scene, the
    outline at the lowest and the highest taxel."""
    scene = thing.scene
    if scene is None:
        z = stage.position_m[:, 2]
        line = np.vstack([thing.outline, thing.outline[:1]])
        return [_at(line, float(height)) for height in np.unique([z.min(), z.max()])]
    return [
        _at(scene.origin + scene.cell * np.asarray(line), float(height))
        for height, grid in zip(scene.heights, scene.slices, strict=True)
        for line in contour_generator(z=grid).lines(0.0)
    ]


def colours_of(z: Floats, live: Bools) -> NDArray[np.uint8]:
    """(n, 3) red, green and blue of activations z (n,): from purple to yellow, grey where nothing
    presses, red where a taxel is not `live` (n,)."""
    colour = colormaps["plasma"](LEAST + (1.0 - LEAST) * z, bytes=True)[:, :3]
    colour[z <= 0.0] = QUIET
    colour[~live] = DEAD
    return colour


def _at(points: Floats, height_m: float) -> Floats:
    """(n, 3) of points (n, 2) at a height."""
    return np.column_stack([points, np.full(len(points), height_m)])
