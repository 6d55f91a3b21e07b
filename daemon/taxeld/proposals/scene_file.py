"""`scene.npz`: a scene as a file; nothing in it is ever unpickled."""

import io
from pathlib import Path

import numpy as np

from taxeld.errors import SetupError
from taxeld.model.scene import Scene
from taxeld.proposals import manifest


def save(scene: Scene, path: Path) -> None:
    """Write `scene.npz`."""
    arrays = {name: np.asarray(getattr(scene, name)) for name in Scene.__dataclass_fields__}
    np.savez_compressed(path, allow_pickle=False, **arrays)


def load(path: Path) -> Scene:
    """The scene in the file at `path`, by the rules of `parse`."""
    return parse(manifest.read(path), path)


def parse(data: bytes, path: Path) -> Scene:
    """The scene in the content of `scene.npz`, named by `path` in messages.

    Raises:
        SetupError: it is damaged, or not a scene.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            values = {name: arrays[name] for name in Scene.__dataclass_fields__}
        cell, symmetry = float(values.pop("cell").item()), int(values.pop("symmetry").item())
        return Scene(**values, cell=cell, symmetry=symmetry)
    except Exception as error:  # exceptions of zip, zlib and numpy's headers share no base
        raise SetupError(
            f"{path}: unusable scene ({manifest.reason(error)}); build the bundle again"
        ) from None
