"""Helpers that several tests of training share: small skins and solids."""

from pathlib import Path

import numpy as np
import trimesh

from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld_sim.objects import scenes
from taxeld_training.models.dataset import simulate

RING = "cylinder:rows=2,columns=16,radius_m=0.04,pitch_m=0.015"
THREE_ROWS = "cylinder:rows=3,columns=8,radius_m=0.04,pitch_m=0.015"
PAPER_RING = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"


def box(x: float = 0.06, y: float = 0.1, z: float = 0.1) -> trimesh.Trimesh:
    """A box that stands on the table."""
    mesh = trimesh.creation.box((x, y, z))
    mesh.apply_translation([0.0, 0.0, z / 2.0])
    return mesh


def can(sides: int = 128, radius: float = 0.05, height: float = 0.1) -> trimesh.Trimesh:
    """A can that stands on the table, or a prism of few sides."""
    mesh = trimesh.creation.cylinder(radius, height, sections=sides)
    mesh.apply_translation([0.0, 0.0, height / 2.0])
    return mesh


def handle() -> trimesh.Trimesh:
    """A bar that sticks out of a can at one side."""
    mesh = trimesh.creation.box((0.06, 0.02, 0.1))
    mesh.apply_translation([0.05, 0.0, 0.05])
    return mesh


def tube(inner_m: float) -> trimesh.Trimesh:
    """A can without lids, hollow."""
    mesh = trimesh.creation.annulus(inner_m, 0.05, 0.1, sections=128)
    mesh.apply_translation([0.0, 0.0, 0.05])
    return mesh


def half_skin() -> Layout:
    """A skin over half of the link, its taxels in no order: no rotation leaves it as it is."""
    rng = np.random.default_rng(1)
    angle = np.sort(rng.uniform(-1.4, 1.4, 60))
    height = rng.choice([-0.008, 0.008], 60)
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(60)], axis=1)
    position = 0.04 * normal
    position[:, 2] = height
    uid = np.array([(i // 10 + 1) << 4 | (i % 10 + 1) for i in range(60)])
    return Layout("half", uid, position, normal, 0.04)


def _on(skin: Layout) -> ObservationModel:
    return ObservationModel(scenes.build(box(), skin, 0.04), skin, 0.005)


# The box on a ring and on a skin without symmetry, and touches of the former
SKIN, HALF_SKIN = layouts.load(RING), half_skin()
MODEL, HALF = _on(SKIN), _on(HALF_SKIN)
TOUCHES = simulate(MODEL, 20_000, np.random.default_rng(0))


def written_at(memory: Path) -> dict[Path, int]:
    """When each file under a folder was written last."""
    return {path: path.stat().st_mtime_ns for path in memory.rglob("*") if path.is_file()}
