"""`taxeld-train build`: an object and a skin → a bundle that the daemon runs."""

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trimesh

from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld_training import bundles
from taxeld_training.objects import meshes, scenes
from taxeld_training.objects.scene_error import grid_error
from taxeld_training.objects.setting import DEPTH_MAX_M
from taxeld_training.samplers import candidates
from taxeld_training.samplers.candidates import Candidates, Progress


def build(
    name: str, layout: Layout, height_m: float, given: Candidates, out: Path, progress: Progress
) -> Path:
    """Build the bundle of `name` (a YCB id or a mesh file) for `layout` in the directory `out`.

    `height_m` is the sensor frame's origin above the object's lowest point. An older bundle in
    `out` is replaced once the new one is complete.

    Raises:
        SetupError: the object or skin cannot be used, or `out` holds something else.
    """
    bundles.check_place(out)
    path, attribution = meshes.find(name)
    mesh = meshes.load(path)
    model = ObservationModel(scenes.build(mesh, layout, height_m), layout, DEPTH_MAX_M)
    info: dict[str, Any] = {"object": path.stem, "attribution": attribution}
    info |= _describe(mesh, model, height_m)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as temporary:
        made = Path(temporary) / "bundle"
        made.mkdir()
        info |= candidates.make(model, given, made, progress)
        bundles.write(model.scene, info, made)
        bundles.replace(made, out)
    return out


def _describe(mesh: trimesh.Trimesh, model: ObservationModel, height_m: float) -> dict[str, Any]:
    """The part of bundle.json about the object on the skin."""
    scene, layout = model.scene, model.layout
    return {
        "layout": {"name": layout.name, "digest": layout.digest},
        "height_m": height_m,
        "depth_max_m": model.depth_max_m,
        "symmetry": scene.symmetry,
        "repairs": scenes.repairs(mesh, layout, height_m),
        "grid_error_mm": asdict(grid_error(scene, mesh, layout, height_m, model.depth_max_m)),
    }
