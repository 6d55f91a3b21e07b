"""Skins of three pitches on the same link, and a picture of presses on them beside the model.

A length that is given in pitches, or in millimetres where the foam has it in the other, is right on
one of them alone.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model import sag
from taxeld.model.leak import Leak
from taxeld.model.noise import FLOOR
from taxeld_hil.scenario.mesh_config import SKINS
from taxeld_hil.world.mesh_physics import MeshPhysics
from taxeld_hil.world.mesh_skin import MeshSkin

LAYOUTS = {  # by pitch [mm]: each covers about the same area of the same link
    6.5: "cylinder:rows=11,columns=39,radius_m=0.04,pitch_m=0.0065",
    15.0: "cylinder:rows=5,columns=17,radius_m=0.04,pitch_m=0.015",
    25.0: "cylinder:rows=3,columns=10,radius_m=0.04,pitch_m=0.025",
}
TIP_M = 0.007  # radius of the fingertip that presses
DEPTHS_M = 0.002, 0.0045
PRESSES = 150  # on a skin of its own each
FARTHEST_MM = 45.0  # from the press


@dataclass
class Fingertip:
    """A ball whose frame is at its middle, on the sensor's height `z_m`."""

    z_m: float = 0.0
    centre = np.zeros(2)
    size = TIP_M

    def distance(self, points: Floats) -> Floats:
        """Like `Solid.distance`: points (3, n) [m] → (n,) [m]."""
        x, y, z = points
        return np.asarray(np.sqrt(x**2 + y**2 + (z - self.z_m) ** 2) - TIP_M)


@dataclass(frozen=True)
class PressReadings:
    """What N taxels read of presses."""

    apart_mm: Floats  # (N,) from the middle of the press
    z: Floats  # (N,) activations
    bound: Floats  # (N,) what the model expects, at a sag that is longer by a standard deviation
    pressed: Bools  # (N,) the ball itself presses the taxel

    @property
    def mistaken(self) -> Bools:
        """(N,) readings beside the press that are more than the model expects."""
        return np.asarray(~self.pressed & (self.z >= np.maximum(FLOOR, self.bound)))


def draw(foam: str, out: Path) -> None:
    """Write the picture as PNG. Raises OSError."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    panels = figure.subplots(1, len(LAYOUTS), sharex=True, sharey=True)
    for axes, (pitch_mm, spec) in zip(panels, LAYOUTS.items(), strict=True):
        _panel(axes, readings(layouts.load(spec), foam), f"{pitch_mm:g} mm apart")
    panels[0].set_ylabel("share of full scale", fontsize=8)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    figure.suptitle(
        f"What taxels read of a fingertip's press on {foam} foam, and what the model expects",
        fontsize=10,
    )
    figure.savefig(out, dpi=90, format="png")


def readings(layout: Layout, foam: str, presses: int = PRESSES, seed: int = 0) -> PressReadings:
    """Presses at random places, each on another skin of this foam."""
    config, rng = SKINS[foam], np.random.default_rng(seed)
    depth_max_m, tip, leak = SkinConfig().full_scale_depth_m, Fingertip(), Leak(layout)
    skin = MeshSkin(tip, layout, config.taxel_radius_m, depth_max_m=depth_max_m)
    hard = np.zeros(len(layout))
    z_max = float(layout.position_m[:, 2].max())
    found = []
    for _ in range(presses):
        gain = np.maximum(1.0 + config.gain_cv * rng.standard_normal(len(layout)), 0.1)
        physics = MeshPhysics(config, skin, layout, depth_max_m, gain, rng)
        angle, tip.z_m = rng.uniform(-np.pi, np.pi), rng.uniform(-z_max, z_max)
        side = np.array([np.cos(angle), np.sin(angle)])
        seen = np.array([*((layout.radius_m + TIP_M - rng.uniform(*DEPTHS_M)) * side), 0.0])
        read = np.minimum(physics.press(seen, 0.0), 1.0)
        z = np.where(read < FLOOR, 0.0, read)
        at = np.array([*(layout.radius_m * side), tip.z_m])
        apart_mm = 1e3 * np.linalg.norm(layout.position_m - at, axis=1)
        bound = np.maximum(_sag(layout, tip.z_m, seen, depth_max_m), leak.of(z))
        found.append((apart_mm, z, bound, skin.indentation(seen, hard) > 0.0))
    apart_mm, z, bound, pressed = map(np.concatenate, zip(*found, strict=True))
    return PressReadings(apart_mm, z, bound, pressed)


def _sag(layout: Layout, z_m: float, seen: Floats, depth_max_m: float) -> Floats:
    """(M,) what the model expects of a ball at height `z_m`, seen at (3,), where the cover sags
    farther by a standard deviation."""
    x, y, z = layout.position_m.T
    ball = np.sqrt(np.maximum(TIP_M**2 - (z - z_m) ** 2, 0.0))  # radius at the taxel's height
    far = np.hypot(x - seen[0], y - seen[1])
    depth = np.where(ball > 0.0, ball - far, -1.0)
    along = np.abs(y * (x - seen[0]) - x * (y - seen[1])) / (far * np.hypot(x, y))
    rate = along * sag.LENGTH_M * np.exp(sag.LENGTH_SD) / depth_max_m
    read = sag.sagging(depth / depth_max_m, np.maximum(rate, sag.LEAST))
    return np.asarray(read, dtype=np.float64)


def _panel(axes: Axes, seen: PressReadings, title: str) -> None:
    near = seen.apart_mm <= FARTHEST_MM
    beside = near & ~seen.pressed & (seen.z > 0.0)
    for mask, colour, label in (
        (near & seen.pressed, "0.7", "pressed"),
        (beside & ~seen.mistaken, "#0072B2", "beside it, as expected"),
        (beside & seen.mistaken, "#D55E00", "beside it, more than expected"),
    ):
        axes.plot(seen.apart_mm[mask], seen.z[mask], ".", ms=2, color=colour, label=label)
    edges = np.linspace(0.0, FARTHEST_MM, 16)
    bin_of = np.where(seen.pressed, 0, np.digitize(seen.apart_mm, edges))
    level = [np.median(seen.bound[bin_of == k]) for k in range(1, len(edges)) if k in bin_of]
    middle = [np.mean(edges[k - 1 : k + 1]) for k in range(1, len(edges)) if k in bin_of]
    axes.plot(middle, level, "k-", lw=1.4, label="what is expected at most, median")
    axes.axhline(FLOOR, color="0.6", lw=0.8, ls=":")
    share = (beside & seen.mistaken).sum() / max(int(beside.sum()), 1)
    axes.set(yscale="log", ylim=(0.5 * FLOOR, 1.3), xlim=(0.0, FARTHEST_MM))
    axes.set_title(f"{title}: {share:.0%} beside it more than expected", fontsize=9)
    axes.set_xlabel("from the press [mm]", fontsize=8)
    axes.tick_params(labelsize=7)
