"""`scene.npz`: a scene as a file; nothing in it is ever unpickled."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.errors import SetupError
from taxeld.model.scene import Scene
from taxeld.proposals import seal


def save(scene: Scene, path: Path) -> None:
    """Write `scene.npz`."""
    fields = {name: np.asarray(getattr(scene, name)) for name in scene.__dataclass_fields__}
    np.savez_compressed(path, allow_pickle=False, **fields)


def load(path: Path) -> Scene:
    """Read and validate `scene.npz`.

    Raises:
        SetupError: the file is missing, damaged, or not a scene.
    """
    return parse(seal.read(path), path)


def parse(data: bytes, path: Path) -> Scene:
    """The scene in the content of `scene.npz`, which `path` names in messages.

    Raises:
        SetupError: it is damaged, or not a scene.
    """
    try:
        values = _arrays(data)
        for name, kind in (("cell", float), ("symmetry", int)):
            values[name] = kind(values[name])
        return Scene(**values)
    except SetupError as error:
        raise SetupError(f"{path}: {error}; build the bundle again") from None
    except Exception as error:  # those of zip, zlib and numpy's headers share no base
        raise SetupError(
            f"{path}: unreadable scene ({seal.reason(error)}); build the bundle again"
        ) from None


def _arrays(data: bytes) -> dict[str, Any]:
    names = Scene.__dataclass_fields__.keys()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        missing = sorted(names - members.keys())
        if missing:
            raise SetupError(f"lacks {', '.join(missing)}")
        if sum(members[name].file_size for name in names) > seal.MAX_BYTES:
            raise SetupError(f"unpacks to more than {seal.MAX_BYTES >> 20} MiB")
        return {name: _array(archive, members[name]) for name in names}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Any:
    with archive.open(member) as file:
        content = file.read(member.file_size + 1)  # of what is packed, no more is unpacked
    return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
