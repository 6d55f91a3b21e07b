"""A bundle's directory: written, sealed, and put in an older one's place."""

import json
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld.model.scene import Scene
from taxeld.proposals import manifest, scene_file


def check_place(out: Path) -> None:
    """Raises SetupError where `out` holds something else than a bundle."""
    if out.exists() and not (out / manifest.NAME).is_file() and any(out.iterdir()):
        raise SetupError(f"--out: {out} is a directory with other content; name an empty one")


def write(scene: Scene, info: dict[str, Any], directory: Path) -> None:
    """Write `scene.npz`, then `bundle.json` about it and the samplers that are there."""
    scene_file.save(scene, directory / manifest.SCENE)
    _write(info, directory)


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
    paths = [directory / manifest.SCENE, *sorted(directory.glob("*.onnx"))]
    digests = {path.name: manifest.digest(manifest.read(path)) for path in paths}
    sealed = {"format": manifest.FORMAT} | info  # the format stands first
    sealed |= {"format": manifest.FORMAT, "files": digests}
    text = json.dumps(sealed, indent=1) + "\n"
    manifest.parse(text.encode(), directory / manifest.NAME)
    new = directory / f"{manifest.NAME}.new"
    new.write_text(text, encoding="utf-8")
    new.replace(directory / manifest.NAME)
