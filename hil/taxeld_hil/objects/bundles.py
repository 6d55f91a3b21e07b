"""A bundle's directory: written, sealed, and put in an older one's place."""

import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.scene import Scene
from taxeld.proposals import manifest
from taxeld.proposals.analytic import Table
from taxeld_hil.objects import meshes, scenes

MESH = "mesh"  # name, before its suffix, of the copy of a mesh file for the harness


def check_place(out: Path) -> None:
    """Raises SetupError where `out` holds something else than a bundle."""
    if out.exists() and not (out / manifest.NAME).is_file() and any(out.iterdir()):
        raise SetupError(f"--out: {out} is a directory with other content; name an empty one")


def write(
    scene: Scene, info: dict[str, Any], directory: Path, further: Sequence[Scene] = ()
) -> None:
    """Write `scene.npz`, the scenes on further links, which `info` names, and then `bundle.json`
    about them and the samplers that are there."""
    manifest.save_scene(scene, directory / manifest.SCENE)
    for link, one in zip(info.get("links", ()), further, strict=True):
        manifest.save_scene(one, directory / link["scene"])
    _write(info, directory)


def links(at: Sequence[tuple[Layout, float]]) -> list[dict[str, Any]]:
    """The entries in `bundle.json` of further links: their layouts and heights."""
    return [
        {
            "layout": {"name": layout.name, "digest": layout.digest},
            "height_m": height_m,
            "scene": f"scene-{number}.npz",
        }
        for number, (layout, height_m) in enumerate(at, 2)
    ]


def bare(name: str, layout: Layout, height_m: float, depth_m: float, out: Path) -> None:
    """Write a bundle without samplers, with which the daemon looks up simulated contacts, of a YCB
    id or a mesh file; `height_m` is as in `scenes.build`, `depth_m` of a press at full scale.

    Raises:
        SetupError: the object cannot be used, or the skin misses it.
    """
    path, attribution = meshes.find(name)
    scene = scenes.cut(name, layout, height_m)
    info: dict[str, Any] = {"object": path.stem, "attribution": attribution}
    info |= {"layout": {"name": layout.name, "digest": layout.digest}, "height_m": height_m}
    info |= {"depth_max_m": depth_m, "samplers": [], "auto": [Table.name]}
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as temporary:
        made = Path(temporary) / "bundle"
        made.mkdir()
        if Path(name).suffix:  # the harness has the meshes of YCB objects
            info["mesh"] = MESH + path.suffix
            shutil.copyfile(path, made / info["mesh"])
        write(scene, info, made)
        replace(made, out)


def replace(made: Path, out: Path) -> None:
    """Move a finished directory to `out`, in place of an older bundle."""
    if out.is_dir():
        for file in out.iterdir():
            file.unlink()
        out.rmdir()
    made.rename(out)


def seal(directory: Path) -> None:
    """Have `bundle.json` name the files as they are now; one of format 2 becomes one of format 3.

    Raises:
        SetupError: it is no bundle, or cannot be written.
    """
    path = directory / manifest.NAME
    try:
        info = json.loads(manifest.read(path))
    except (ValueError, RecursionError):
        raise SetupError(f"{path}: unreadable; build the bundle again") from None
    if not isinstance(info, dict) or info.get("format") not in (2, manifest.FORMAT):
        raise SetupError(f"{path}: is not of bundle format 2 or {manifest.FORMAT}")
    try:
        _write(info, directory)
    except OSError as error:
        raise SetupError(f"{path}: cannot be written ({error.strerror})") from None


def _write(info: dict[str, Any], directory: Path) -> None:
    """Raises SetupError where the daemon would refuse it."""
    paths = [*sorted(directory.glob("scene*.npz")), *sorted(directory.glob("*.onnx"))]
    digests = {path.name: manifest.digest(manifest.read(path)) for path in paths}
    sealed = {"format": manifest.FORMAT} | info  # the format stands first
    sealed |= {"format": manifest.FORMAT, "files": digests}
    text = json.dumps(sealed, indent=1) + "\n"
    manifest.parse(text.encode(), directory / manifest.NAME)
    new = directory / f"{manifest.NAME}.new"
    new.write_text(text, encoding="utf-8")
    new.replace(directory / manifest.NAME)
