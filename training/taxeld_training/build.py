"""`taxeld-train build`: an object and a skin → a bundle that the daemon runs."""

import shlex
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trimesh

from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld_training import bundles
from taxeld_training.objects import DEPTH_MAX_M, meshes, scenes
from taxeld_training.samplers import candidates
from taxeld_training.samplers.candidates import Candidates, Progress

MESH = "mesh"  # name, before its suffix, of the copy of a mesh file for the harness
SCENE = "scene"
STAGES = (SCENE, *candidates.STAGES)  # stages of a build, in order
FAR = 2.0  # a sampler is poor beyond so many times the distance of two sets of exact draws


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
    if Path(name).suffix:  # the harness has the meshes of YCB objects
        info["mesh"] = MESH + path.suffix
    info |= _describe(mesh, model, height_m)
    progress(SCENE, 1.0)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as temporary:
        made = Path(temporary) / "bundle"
        made.mkdir()
        info |= candidates.make(model, given, made, progress)
        if "mesh" in info:
            shutil.copyfile(path, made / info["mesh"])
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
        "grid_error_mm": asdict(
            scenes.grid_error(scene, mesh, layout, height_m, model.depth_max_m)
        ),
    }


def summary(out: Path, info: dict[str, Any], skin: str) -> Iterator[str]:
    """Lines on the bundle in `out`, how good it is, and the next commands; `skin`: the layout,
    where it is not the default."""
    size = sum(path.stat().st_size for path in out.iterdir())
    samplers = {one["name"]: one["energy_distance"] for one in info["samplers"]}
    best = min(samplers, key=lambda name: samplers[name])
    floor = info["energy_floor"]
    yield f"made       {out}: {info['object']} on {info['layout']['name']}, {size / 1e6:.1f} MB"
    yield f"samplers   {', '.join(samplers)}; auto: {info['auto'][0]}"
    yield (
        f"how good   {best} is {samplers[best]:.3f} from the exact posterior, table "
        f"{info['analytic']['table']['energy_distance']:.3f}; two sets of exact draws are "
        f"{floor:.3f} apart"
    )
    if samplers[best] > FAR * floor:
        yield "           the samplers are poor: build with more --effort and --contacts"
    layout = f" --layout {shlex.quote(skin)}" if skin else ""
    shape = f" --skin {shlex.quote(skin)}" if skin else ""
    yield f"next       taxeld-hil run demo --object {out}{shape} --out demo    # without a robot"
    yield f"           taxeld init robot.toml --bundle {out}{layout}"
