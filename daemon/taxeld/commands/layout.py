"""`taxeld layout`: the facts about a layout, a line each, and the next command."""

import math
import shlex

import numpy as np

from taxeld.layout.layout import Layout

TILT_MAX_RAD = math.radians(30.0)  # the scene model assumes that a taxel gives way along its radius
SAME_PLACE_M = 1e-4  # some files put taxels of unknown place at their neighbour's
ABOVE_M = 0.005  # height of the lowest taxels over the table, in the next command
CLOSED_PITCHES = 2.0  # taxel pitches: a narrower angular gap is only the space between taxels


def summary(layout: Layout) -> list[str]:
    """Lines of a fact each: its name and its value with the unit."""
    source, modules = layout.source, len(np.unique(layout.uid >> 4))
    width, depth, height = np.ptp(layout.position_m, axis=0) * 1e3
    facts = {
        "layout": layout.name,
        "taxels": f"{len(layout)} in {modules} modules",
        "left out": (f"{source.missing} missing, {source.cut} cut, {source.duplicates} duplicate"),
        "unit": {"m": "metres", "mm": "millimetres, read as 0.001 m"}[source.unit],
    }
    if math.isinf(layout.radius_m):
        facts |= {
            "cylinder": f"none ({layout.no_cylinder}); no daemon runs it",
            "size": f"{width:.1f} × {depth:.1f} × {height:.1f} mm along x, y, z",
        }
    else:
        facts |= {
            "cylinder": (
                f"radius {layout.radius_m * 1e3:.1f} mm, "
                f"taxels {layout.rms_m * 1e3:.1f} mm (rms) off it"
            ),
            "arc": f"{math.degrees(arc_rad(layout)):.1f}°",
            "height": f"{height:.1f} mm",
            "normals": (
                f"{'' if source.own_normals else 'found from the positions, '}"
                f"{layout.turned} turned outwards, {tilted(layout)} more than "
                f"{math.degrees(TILT_MAX_RAD):.0f}° from radial"
            ),
            "symmetry": f"order {len(layout.turns)} about the axis",
        }
    facts |= {
        "pitch": f"{pitch_m(layout) * 1e3:.2f} mm to the nearest neighbour (median)",
        "digest": layout.digest,
    }
    lines = [f"{name:<10}{value}" for name, value in facts.items()]
    if not np.array_equal(layout.frame, np.eye(4)):
        lines.append(f"{'frame':<10}from the file's frame [m] to the sensor frame")
        lines += ["  " + " ".join(f"{value:9.5f}" for value in row) for row in layout.frame]
    return lines


def next_command(spec: str, layout: Layout) -> list[str]:
    """The line of the command that follows, for the layout that `spec` names; none without a
    cylinder."""
    if math.isinf(layout.radius_m):
        return []
    height = math.ceil((ABOVE_M - layout.position_m[:, 2].min()) * 1e3) / 1e3
    words = ["taxeld-train", "scene", "MESH", "--layout", spec, "--height-m", f"{height:g}"]
    return [f"next      {shlex.join(words)}    # the frame's height over the table; here the least"]


def arc_rad(layout: Layout) -> float:
    """The angle about the axis that the taxels cover [rad]: a full turn less the widest gap."""
    angle = np.sort(np.arctan2(layout.position_m[:, 1], layout.position_m[:, 0]))
    gap = float(np.diff(angle, append=angle[0] + 2.0 * np.pi).max())
    closed = gap * layout.radius_m <= CLOSED_PITCHES * pitch_m(layout) or len(layout.turns) > 1
    return 2.0 * math.pi if closed else 2.0 * math.pi - gap


def pitch_m(layout: Layout) -> float:
    """Median distance [m] to the nearest taxel at another place; nan where there is none."""
    cells = np.round(layout.position_m / SAME_PLACE_M)
    places = layout.position_m[np.unique(cells, axis=0, return_index=True)[1]]
    if len(places) < 2:
        return math.nan
    nearest = [np.partition(np.linalg.norm(places - place, axis=1), 1)[1] for place in places]
    return float(np.median(nearest))


def tilted(layout: Layout) -> int:
    """The number of normals more than TILT_MAX_RAD off their taxel's radius."""
    radial = layout.position_m[:, :2]
    along = np.einsum("ij,ij->i", radial, layout.normal[:, :2])
    return int((along < np.cos(TILT_MAX_RAD) * np.hypot(*radial.T)).sum())
