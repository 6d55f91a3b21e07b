"""What `taxeld-train scene` and `build` do by their arguments: lines, and warnings on stderr."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import trimesh

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.scene import CONTINUOUS
from taxeld_hil.objects import meshes, scenes
from taxeld_training import build as bundles
from taxeld_training import several
from taxeld_training.build import SCENE, STAGES, command, summary
from taxeld_training.filters import alike
from taxeld_training.filters.touches import EndTrials
from taxeld_training.jobs import stages
from taxeld_training.models.variants import diffusion, trained_with
from taxeld_training.objects.doubts import doubts
from taxeld_training.samplers.candidates import (
    CONTACTS,
    TRAINING,
    VARIANTS,
    Candidates,
    Progress,
)

DEPTHS_MM = 0.1, 50.0  # limits, as of skin.full_scale_depth_m
UPRIGHT = "the link's axis must be vertical (within 0.1 rad), and the object stand as its mesh does"
LONGER = 3.0  # times the effort, as a cure for poor samplers
QUICK = {"effort": 0.02, "contacts": 30_000, "bank": 50_000, "readings": 10, "trials": 8}

Make: TypeAlias = Callable[..., None]  # builds the bundle of an object in a directory


def scene(args: argparse.Namespace) -> Iterator[str]:
    """What the skin meets of an object."""
    depth_m, skin = _depth_m(args), layouts.load(args.layout)
    mesh = meshes.load(meshes.find(args.object)[0])
    cut = scenes.build(mesh, skin, args.height_m)
    error = scenes.grid_error(cut, mesh, skin, args.height_m, depth_m)
    heights = (args.height_m + cut.heights) * 1e3
    met = sum(bool((piece < 0.0).any()) for piece in cut.slices)
    turn = {CONTINUOUS: "continuous", 1: "none"}.get(cut.symmetry, f"{cut.symmetry}-fold")
    repairs = scenes.repairs(mesh, skin, args.height_m)
    size = cut.slices.nbytes + cut.silhouette.nbytes
    yield f"upright     {UPRIGHT}"
    yield f"extents     {' × '.join(f'{length * 1e3:.0f}' for length in mesh.extents)} mm"
    yield (
        f"slices      {len(heights)}, {heights[0]:.0f} to {heights[-1]:.0f} mm above the lowest "
        f"point, {met} of which meet the object"
    )
    yield f"symmetry    {turn}"
    yield f"repairs     {'; '.join(repairs) or 'none'}"
    yield f"grid error  rms {error.rms:.3f}, 99 % under {error.p99:.3f}, max {error.max:.3f} mm"
    yield f"grid        {size / 1e3:.0f} kB"
    yield f"next        {command(args.object, args.layout, args.height_m, depth_m)}"
    _doubt(args, args.object, mesh, skin)
    if args.png:
        from taxeld_training.objects import scene_picture  # noqa: PLC0415  (an extra)

        title = f"{args.object} on {skin.name}\n{UPRIGHT}"
        try:
            scene_picture.draw(mesh, cut, skin, args.height_m, title, args.png)
        except OSError as error:
            raise SetupError(f"--png: cannot write {args.png} ({error.strerror})") from None


def build(args: argparse.Namespace) -> Iterator[str]:
    """A bundle, or one of each of several objects."""
    full = {"effort": 1.0, "contacts": 300_000, "trials": EndTrials.trials}
    full |= {"bank": Candidates.bank, "readings": Candidates.readings}
    named = {name: getattr(args, name) for name in full if getattr(args, name) is not None}
    size = full | (QUICK if args.quick else {}) | named
    wanted = (*VARIANTS, diffusion()) if args.ddpm else VARIANTS
    given = Candidates(
        variants=tuple(
            trained_with(v, size["effort"], int(size["contacts"]), args.seed) for v in wanted
        ),
        bank=int(size["bank"]),
        readings=int(size["readings"]),
        seed=args.seed,
    )
    asked = EndTrials(args.foam, int(size["trials"]), args.seed)
    depth_m, skin = _depth_m(args), layouts.load(args.layout)
    is_one = len(args.object) == 1
    if not (is_one or args.samplers):
        unused = [name for name in ("ddpm", *named) if getattr(args, name) and name != "trials"]
        if unused:
            raise SetupError(f"--{unused[0]}: trains nothing of several objects; add --samplers")
    places = {args.object[0]: args.out} if is_one else several.places(args.object, args.out)
    if not is_one:
        several.check(args.object, skin, args.height_m, depth_m)
    for name in places:
        _doubt(args, name, meshes.load(meshes.find(name)[0]), skin)
    further = _further(args)

    def make(name: str, out: Path, progress: Progress, *, samplers: bool = True) -> None:
        trained = given if samplers else None
        bundles.build(name, skin, args.height_m, depth_m, trained, asked, out, progress, further)

    began_s = time.monotonic()
    for number, (name, out) in enumerate(places.items(), 1):
        if is_one or args.samplers:
            if not is_one:
                _warn(f"{number}/{len(places)} {name}")
            yield from _built(args, name, out, make)
    if not is_one:
        yield from _pairs(args, places, skin, asked, make)
        yield f"took       {time.monotonic() - began_s:.0f} s"
        yield several.key_line(list(places.values()))


def _built(args: argparse.Namespace, name: str, out: Path, make: Make) -> Iterator[str]:
    """Build a bundle with samplers; → lines on it, and how long it took."""
    began_s, ended_s = time.monotonic(), dict[str, float]()
    with stages.shown(STAGES, sys.stderr) as tell:

        def progress(stage: str, share: float) -> None:
            ended_s[stage] = time.monotonic()
            tell(stage, share)

        make(name, out, progress)
    info = json.loads((out / "bundle.json").read_text(encoding="utf-8"))
    for repair in info["repairs"]:
        _warn(f"taxeld-train: {name}: {repair}")
    took_s = time.monotonic() - began_s
    longer = took_s + (LONGER - 1.0) * (ended_s[TRAINING] - ended_s[CONTACTS])
    effort = 1.0 if args.effort is None else args.effort
    more = f"--effort {LONGER * effort:g} would take about {longer / 60.0:.0f} min here"
    if args.quick:
        more = "--quick asked for no more; build without it for use"
    yield from summary(out, info, args.layout, more)
    yield f"took       {took_s:.0f} s"


def _pairs(
    args: argparse.Namespace, places: dict[str, Path], skin: Layout, asked: EndTrials, make: Make
) -> Iterator[str]:
    """Try which of several objects touch can tell apart; bundles without samplers are built."""
    made = (alike.STAGE,) if args.samplers else (SCENE, alike.STAGE)
    with stages.shown(made, sys.stderr) as tell:
        for number, (name, out) in enumerate(() if args.samplers else places.items(), 1):
            make(name, out, lambda *_: None, samplers=False)
            tell(SCENE, number / len(places))
        told = alike.pairs(list(places.values()), skin, asked, tell)
    yield from map(several.size_line, () if args.samplers else places.values())
    yield from several.tell_pairs(told, args.out)


def _further(args: argparse.Namespace) -> list[tuple[Layout, float]]:
    """Layouts and heights of further links: each as often as the other, or one height for all.
    Raises SetupError."""
    named, heights = getattr(args, "layout_more", []), getattr(args, "height_m_more", [])
    if heights and len(heights) != len(named):
        raise SetupError(
            f"--height-m: {len(heights) + 1} heights for {len(named) + 1} layouts; give one for "
            "all, or one for each --layout"
        )
    heights = heights or [args.height_m] * len(named)
    return [(layouts.load(one), height) for one, height in zip(named, heights, strict=True)]


def _depth_m(args: argparse.Namespace) -> float:
    """The depth of a press at full scale. Raises SetupError."""
    least, most = DEPTHS_MM
    if not least <= args.depth_mm <= most:
        raise SetupError(f"--depth-mm: must be {least:g}..{most:g}, not {args.depth_mm:g}")
    return float(args.depth_mm / 1e3)


def _doubt(args: argparse.Namespace, name: str, mesh: trimesh.Trimesh, skin: Layout) -> None:
    """Warn of probable faults in how the mesh lies and is cut."""
    for line in doubts(mesh, skin, args.height_m):
        _warn(f"taxeld-train: {name}: warning: {line}")


def _warn(line: str) -> None:
    sys.stderr.write(f"{line}\n")
