"""Samplers on a damaged skin: distance to the exact posterior against the share of dead taxels.

On the shipped bundles' own samplers, so nothing is trained.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from taxeld import bundle, layout
from taxeld.config import SkinConfig
from taxeld.observation import Noise
from taxeld_training import picture, quality
from taxeld_training.build import DEPTH_MAX_M

BUNDLES = ("box", "mug")
SHARES = (0.0, 0.1, 0.2, 0.4, 0.6)
PROPOSALS = ("density", "ddpm", "table", "manifold")


def measure(name: str, dead: float, readings: int, bank: int, seed: int) -> list[dict[str, Any]]:
    """Rows of all proposals of a shipped bundle with a share of the taxels dead, others in each
    reading."""
    loaded = bundle.load(name, layout.load(SkinConfig().layout), DEPTH_MAX_M)
    rng = np.random.default_rng(seed)
    to = quality.reference(loaded.model, Noise(), readings, rng, dead=dead, bank=bank)
    return [
        {
            "object": loaded.info["object"],
            "dead_share": dead,
            "proposal": kind,
            "energy_distance": quality.distance(loaded.proposal(kind), to, rng),
            "energy_floor": to.floor,
            "readings": len(to.z),
        }
        for kind in PROPOSALS
    ]


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """One panel an object, one line a proposal, the floor below."""
    objects = sorted({str(row["object"]) for row in rows})
    style = picture.styles(PROPOSALS)
    figure = Figure(figsize=(4.2 * len(objects), 3.4), layout="constrained")
    for at, name in enumerate(objects):
        axes = figure.add_subplot(1, len(objects), at + 1)
        mine = [row for row in rows if row["object"] == name]
        for kind in PROPOSALS:
            points = [
                (r["dead_share"], r["energy_distance"]) for r in mine if r["proposal"] == kind
            ]
            colour, marker = style[kind]
            axes.plot(*zip(*points, strict=True), color=colour, marker=marker, label=kind)
        floor = sorted({(row["dead_share"], row["energy_floor"]) for row in mine})
        axes.plot(*zip(*floor, strict=True), color="black", ls=":", label="floor")
        axes.set(title=name, xlabel="share of dead taxels", yscale="log")
        if at == 0:
            axes.set_ylabel("energy distance to the exact posterior")
            axes.legend(fontsize=8)
    picture.save(figure, path)
