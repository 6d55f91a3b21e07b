"""The streams as Rerun's entities: `world/…` in three dimensions, `status` in words, `plot/…`."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps

from taxeld.arrays import Floats, Poses
from taxeld.commands.status import estimate_rows
from taxeld.model import se2
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.stream import topics

DRAWN = topics.TAXELS, topics.ESTIMATE, topics.PARTICLES  # topics of a scan
TIME = "scan"  # the time line: Unix time of the measurement
LINES = 5  # outlines of an object, from the lowest taxel to the highest
TAXEL_M, PRESSED_M, LINE_M = 0.002, 0.004, 0.0008  # radii of points and lines
ARROW_M = 0.02  # length of a particle's arrow
FOUND, MODE, PARTICLE, TRUTH = (230, 60, 60), (70, 150, 255), (130, 180, 230), (240, 240, 240)
QUIET, DEAD = (120, 120, 120), (200, 30, 30)  # taxels that nothing presses, and that do not work
LEAST = 0.25  # beginning on the colour scale: darker colours do not show on black
PLOTS = "belief", "spread", "error"


class Picture:
    """Skin and objects are those of the last `/taxeld/info`: what a restarted daemon says of others
    is left out until its own info has come."""

    def __init__(self, scenes: Sequence[Scene] = (), truth: Poses | None = None) -> None:
        """`truth` (3,): the true pose, which is used where there is one scene."""
        self.stream = rr.RecordingStream("taxeld")
        self._scenes, self._truth = scenes, truth if len(scenes) == 1 else None
        self._info: dict[str, Any] = {}
        self._outlines: list[list[Floats]] = []  # (P, 2) of an object's parts in its frame, closed
        self._middle = np.zeros(3)  # of the object that was drawn last, in its own frame

    def take(self, topic: bytes, m: dict[str, Any]) -> None:
        """Draw one of the streams' maps; those of other topics are left out."""
        if topic == topics.INFO and m != self._info:  # it comes again for each new subscriber
            self._set(m)
        elif self._info and topic in DRAWN and m["t"]:  # a time of 0: nothing was measured yet
            self.stream.set_time(TIME, timestamp=m["t"])
            takes = (self._taxels, self._estimate, self._particles)
            takes[DRAWN.index(topic)](m)

    def _set(self, info: dict[str, Any]) -> None:
        self._info = info
        self._outlines = [
            [np.array([*line, line[0]]) for line in each["outlines"]] for each in info["objects"]
        ]
        self._position_m = np.array(info["layout"]["position_m"])
        z = self._position_m[:, 2]
        self._heights_m, self._middle_m = np.linspace(z.min(), z.max(), LINES), float(z.mean())
        words, scene = rrb.TextDocumentView(origin="/status"), rrb.Spatial3DView(origin="/world")
        plots = [rrb.TimeSeriesView(origin=f"/plot/{name}") for name in PLOTS]
        time = rrb.TimePanel(timeline=TIME, play_state="following", state="collapsed")
        both = rrb.Horizontal(scene, rrb.Vertical(words, *plots), column_shares=[2, 1])
        self.stream.send_blueprint(rrb.Blueprint(both, time, collapse_panels=True))
        self.stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if self._truth is not None:
            lines = self._lines(0, self._truth, self._heights_m)
            true = rr.LineStrips3D(lines, colors=TRUTH, radii=LINE_M / 2)
            self.stream.log("world/truth", true, static=True)

    def _taxels(self, m: dict[str, Any]) -> None:
        if m.get("link") or len(m["z"]) != len(self._position_m):  # the first link alone is drawn
            return
        if m["placed"]:
            x, y, theta = pose_of(m["sensor"]).tolist()
            turn = rr.RotationAxisAngle((0.0, 0.0, 1.0), radians=theta)
            self.stream.log("world/link", rr.Transform3D(translation=(x, y, 0.0), rotation=turn))
        z, live = np.array(m["z"], dtype=float), np.array(m["live"], dtype=bool)
        radii = np.where(z > 0.0, PRESSED_M, TAXEL_M)
        colours = colormaps["plasma"](LEAST + (1.0 - LEAST) * z, bytes=True)[:, :3]
        colours[z <= 0.0], colours[~live] = QUIET, DEAD
        skin = rr.Points3D(self._position_m, colors=colours, radii=radii)
        self.stream.log("world/link/skin", skin)

    def _estimate(self, e: dict[str, Any]) -> None:
        modes = e["modes"] if e["valid"] else []
        if any(one["object"] >= len(self._outlines) for one in (e, *modes)):
            return
        self._middle = np.array([*self._outlines[e["object"]][0][:-1].mean(axis=0), 0.0])
        rows, found = [f"**{name}** {text}" for name, text in estimate_rows(e)], []
        if e["valid"]:
            likeliest, var = pose_of(e["map"]), np.diag(np.array(e["cov"], dtype=float))
            x, y, yaw = np.sqrt(np.maximum(var, 0.0)).tolist()
            found = self._lines(e["object"], likeliest, self._heights_m)
            values = {"spread/x_mm": 1e3 * x, "spread/y_mm": 1e3 * y, "belief/p": e["p"]}
            values |= {f"belief/{name}": p for name, p in e["hypotheses"].items()}
            values["spread/theta_deg"] = math.degrees(yaw)
            if self._truth is not None:
                values["error/add_mm"] = 1e3 * add_m(self._scenes[0], likeliest, self._truth)[1]
            for series, value in values.items():
                self.stream.log(f"plot/{series}", rr.Scalars(value))
        at = [self._middle_m]
        strips = [line for one in modes for line in self._lines(one["object"], pose_of(one), at)]
        colours = [(*MODE, round(255 * max(one["weight"], 0.4))) for one in modes]
        self.stream.log("world/object", rr.LineStrips3D(found, colors=FOUND, radii=LINE_M))
        self.stream.log("world/modes", rr.LineStrips3D(strips, colors=colours, radii=LINE_M))
        self.stream.log("status", rr.TextDocument("\n\n".join(rows), media_type="text/markdown"))

    def _particles(self, m: dict[str, Any]) -> None:
        pose = np.array(m["xytheta"], dtype=float).reshape(-1, 3)
        at, yaw = se2.compose(pose, self._middle), pose[:, 2]
        at[:, 2] = self._middle_m
        along = ARROW_M * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
        arrows = rr.Arrows3D(origins=at, vectors=along, colors=PARTICLE, radii=LINE_M)
        self.stream.log("world/particles", arrows)

    def _lines(self, number: int, pose: Poses, heights_m: Iterable[float]) -> list[Floats]:
        """The outlines of an object at a pose, at each of the heights."""
        placed = [se2.apply(pose, line) for line in self._outlines[number]]
        return [np.insert(line, 2, height, axis=1) for height in heights_m for line in placed]


def pose_of(planar: dict[str, float]) -> Poses:
    """(3,) of `x`, `y`, `theta`."""
    return np.array([planar["x"], planar["y"], planar["theta"]])
