"""A bundle's directory: written, sealed, and put in an older one's place."""

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals import manifest
from taxeld.proposals.analytic import Table, check_contacts
from taxeld_sim.objects import meshes, scenes

MESH = "mesh"  # name, before its suffix, of the copy of a mesh file for the harness

Links = Sequence[tuple[Layout, float]]
"""The layout of each link, and how high its frame's origin is above the object's lowest point."""


def check_place(out: Path) -> None:
    """Raises SetupError where no bundle can be put: `out` holds something else than one, or cannot
    be written."""
    try:
        held = list(out.iterdir()) if out.exists() else []
        if (held and not (out / manifest.NAME).is_file()) or any(one.is_dir() for one in held):
            raise SetupError(f"--out: {out} is a directory with other content; name an empty one")
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out if out.exists() else out.parent):
            pass
    except OSError as error:
        raise SetupError(
            f"--out: {out} cannot be written ({error.strerror}); name another directory"
        ) from None


@contextmanager
def replacing(out: Path) -> Iterator[Path]:
    """An empty directory for a bundle, which is moved to `out` in the end, in place of an older
    bundle; after a fault `out` is as before."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as temporary:
        made = Path(temporary) / "made"
        made.mkdir()
        yield made
        if out.exists():
            out.rename(made.with_name("older"))
        made.rename(out)


def write(name: str, links: Links, depth_m: float, directory: Path) -> ObservationModel:
    """Write a bundle of a YCB id or a mesh file without samplers: simulated contacts propose poses.
    `depth_m` is that of a press at full scale. → The model of the first link.

    Raises:
        SetupError: the object cannot be used, or the skin misses it.
    """
    path, attribution = meshes.find(name)
    mesh = meshes.load(path)
    made = scenes.build_all(mesh, links)
    model = ObservationModel(made[0], links[0][0], depth_m)
    check_contacts(model)
    files = [manifest.SCENE, *(f"scene-{number}.npz" for number in range(2, len(links) + 1))]
    for scene, file in zip(made, files, strict=True):
        manifest.save_scene(scene, directory / file)
    first, *further = [
        {"layout": {"name": layout.name, "digest": layout.digest}, "height_m": height_m}
        for layout, height_m in links
    ]
    info: dict[str, Any] = {"object": path.stem, "attribution": attribution, **first}
    info |= {"depth_max_m": depth_m, "symmetry": model.scene.symmetry}
    info["repairs"] = scenes.repairs(mesh, *links[0])
    if further:
        info["links"] = [
            link | {"scene": file} for link, file in zip(further, files[1:], strict=True)
        ]
    if Path(name).suffix:  # the harness has the meshes of YCB objects
        info["mesh"] = MESH + path.suffix
        shutil.copyfile(path, directory / info["mesh"])
    _write(info | {"samplers": [], "auto": [Table.name]}, directory)
    return model


def seal(directory: Path, more: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Have `bundle.json` name the files as they are now, and say what `more` says.

    Raises:
        SetupError: it is no bundle, or cannot be written.
    """
    path = directory / manifest.NAME
    text = manifest.read(path)
    manifest.parse(text, path)
    info: dict[str, Any] = json.loads(text)
    try:
        _write(info | dict(more), directory)
    except OSError as error:
        raise SetupError(f"{path}: cannot be written ({error.strerror})") from None


def _write(info: dict[str, Any], directory: Path) -> None:
    """Raises SetupError where the daemon would refuse it."""
    paths = [*sorted(directory.glob("scene*.npz")), *sorted(directory.glob("*.onnx"))]
    digests = {path.name: manifest.digest(manifest.read(path)) for path in paths}
    sealed = {"format": manifest.FORMAT} | info | {"files": digests}  # the format stands first
    text = json.dumps(sealed, indent=1) + "\n"
    manifest.parse(text.encode(), directory / manifest.NAME)
    new = directory / f"{manifest.NAME}.new"
    new.write_text(text, encoding="utf-8")
    new.replace(directory / manifest.NAME)
