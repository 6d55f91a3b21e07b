"""`taxeld-train build`: an object and a skin → a bundle that the daemon runs; and the commands that
follow one another on the way there."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import Table
from taxeld_hil.objects import bundles, meshes, scenes
from taxeld_training.filters import touches
from taxeld_training.filters.cells import TOUCHES
from taxeld_training.filters.methods import SHIPPED, Method
from taxeld_training.jobs.statistics import of_count
from taxeld_training.samplers import candidates
from taxeld_training.samplers.candidates import Candidates, Progress

SCENE = "scene"
STAGES = (SCENE, *candidates.STAGES, touches.STAGE)  # stages of a build, in order
SURE_AFTER = 6, 8  # touches that the summary speaks of


def build(
    name: str,
    layout: Layout,
    height_m: float,
    depth_m: float,
    given: Candidates | None,
    asked: touches.EndTrials,
    out: Path,
    progress: Progress,
    further: Sequence[tuple[Layout, float]] = (),
) -> Path:
    """Build the bundle of `name` (a YCB id or a mesh file) for `layout` in the directory `out`.

    `height_m` is the sensor frame's origin above the object's lowest point, `depth_m` the depth of
    a press at full scale. `further`: layouts and heights of further links; samplers are of the
    first. What is made is tried as `asked`; without `given` samplers the table is
    left to propose, and nothing is tried. An older bundle in `out` is replaced once the new one is
    complete.

    Raises:
        SetupError: the object or skin cannot be used, or `out` holds something else.
    """
    bundles.check_place(out)
    mesh = meshes.load(meshes.find(name)[0])
    scene, *more = scenes.build_all(mesh, [(layout, height_m), *further])
    model = ObservationModel(scene, layout, depth_m)
    error = scenes.grid_error(scene, mesh, layout, height_m, depth_m)
    info = bundles.about(name, layout, height_m, depth_m) | {
        "symmetry": scene.symmetry,
        "repairs": scenes.repairs(mesh, layout, height_m),
        "grid_error_mm": asdict(error),
    }
    if further:
        info["links"] = bundles.links(further)
    progress(SCENE, 1.0)
    with bundles.making(name, info, out) as made:
        if given is None:
            info |= {"samplers": [], "auto": [Table.name]}
        else:
            info |= candidates.make(model, given, made, progress)
        bundles.write(scene, info, made, more)
        if given is not None:
            info |= touches.counted(made, layout, asked, progress)
            bundles.write(scene, info, made, more)
    return out


def command(name: str, layout: str, height_m: float, depth_m: float) -> str:
    """The command that builds a first bundle of an object on a layout."""
    words = ["taxeld-train", "build", name, *_layout(layout), "--height-m", f"{height_m:g}"]
    if depth_m != SkinConfig().full_scale_depth_m:
        words += ["--depth-mm", f"{1e3 * depth_m:g}"]
    return shlex.join([*words, "--quick", "--out", Path(name).stem])


def summary(out: Path, info: dict[str, Any], layout: str, more: str) -> Iterator[str]:
    """Lines on the bundle in `out`, how good it is in touches, and the next commands. `layout`: as
    it was given; `more`: a cure for a sampler that finds less than the table."""
    size = sum(path.stat().st_size for path in out.iterdir())
    yield f"made       {out}: {info['object']} on {info['layout']['name']}, {size / 1e6:.1f} MB"
    yield f"samplers   {', '.join(s['name'] for s in info['samplers'])}; auto: {info['auto'][0]}"
    tried, enough = info["touches"], info.get("filter")
    found, (after, last) = tried["found_and_sure"], SURE_AFTER
    table, sampler = (name for name in found if name.endswith(touches.size(SHIPPED)))
    shown = [sampler, table]
    if enough:
        own = Method(info["auto"][0], "", enough["particles"], enough["particles_max"])
        shown.insert(0, f"{own.proposal} {touches.size(own)}")
        yield f"enough     {shown[0]} particles, {enough['injected']} samples"
    for k, name in enumerate(dict.fromkeys(shown)):
        first, then = found[name][after - 1], found[name][last - 1]
        misled = sum(tried["misleading"][name])
        if k:
            yield f"           {name}: {first}, {then} after {last}; {misled} misleading"
            continue
        yield (
            f"how good   {name}: {first} of {tried['trials']} found and sure after {after} touches "
            f"on {tried['foam']} foam, {then} after {last}; "
            f"{misled} of {tried['trials'] * TOUCHES} estimates misleading"
        )
    counts = found[sampler][after - 1], found[table][after - 1]
    if of_count(counts[0], tried["trials"])[1] < counts[1] / tried["trials"]:  # beyond chance
        yield f"           {more}"
    run = ["taxeld-hil", "run", "demo", "--object", str(out), *_layout(layout)]
    yield f"next       {shlex.join([*run, '--out', f'{out.name}_demo'])}"


def _layout(given: str) -> list[str]:
    """The option, but for the default."""
    return ["--layout", given] if given != SkinConfig().layout else []
