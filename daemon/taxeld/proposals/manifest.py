"""The files of a bundle: `bundle.json`, which describes it and has the digests of the others, and
`scene.npz`, the object.

Each file is read once: the compared bytes are the ones that are parsed. Nothing is ever unpickled.
"""

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taxeld import files
from taxeld.config import gate
from taxeld.config.gate import Given, between, key, one_of
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.model.scene import Scene
from taxeld.proposals.analytic import ANALYTIC

NAME = "bundle.json"
SCENE = "scene.npz"
FORMAT = 3
KINDS = ("density", "ddpm")  # kinds of samplers
AGAIN = "build the bundle again"
DEPTH = SkinConfig.__dataclass_fields__["full_scale_depth_m"].metadata["check"]


@dataclass(frozen=True, slots=True)
class BuiltFor:
    """The layout for which a bundle was built."""

    name: str
    digest: str


@dataclass(frozen=True, slots=True)
class LinkEntry:
    """A link for which a bundle was built."""

    layout: BuiltFor
    height_m: float = key(check=between(-10, 10))
    scene: str = key()  # the object at the heights of this link: a file


@dataclass(frozen=True, slots=True)
class SamplerEntry:
    """A sampler of a bundle."""

    name: str
    kind: str = key(check=one_of(*KINDS))
    file: str = key()


@dataclass(frozen=True, slots=True)
class Trials:
    """The trials that a build ended with."""

    foam: str
    trials: int
    # by filter, how many trials are found and sure after each touch, or misled
    found_and_sure: dict[str, tuple[int, ...]]
    misleading: dict[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class Manifest:
    """The keys of `bundle.json`. Lengths in metres."""

    format: int
    object: str
    layout: BuiltFor
    files: dict[str, str]  # name → SHA-256 of each file beside bundle.json
    samplers: tuple[SamplerEntry, ...]
    auto: tuple[str, ...]  # proposals by preference
    height_m: float = key(check=between(-10, 10))
    depth_max_m: float = key(check=DEPTH)
    attribution: str | None = None  # that the mesh requires
    symmetry: int = 1  # number of turns that leave the object as it is
    repairs: tuple[str, ...] = ()  # of the mesh
    links: tuple[LinkEntry, ...] = ()  # further ones; the first one's is `layout`
    mesh: str = ""  # a file of the bundle with the mesh, where the object is not one of YCB's
    # as many particles and samples as were enough when the bundle was built
    filter: Given[FilterConfig] = field(default_factory=Given)
    noise: dict[str, float] = field(default_factory=dict)  # that the samplers have learned
    touches: Trials | None = None

    @property
    def all_links(self) -> list[LinkEntry]:
        """The links for which the bundle was built, the one that has the samplers first."""
        return [LinkEntry(self.layout, self.height_m, SCENE), *self.links]

    @property
    def fault(self) -> str:
        """Why the values do not belong together; empty where they do."""
        for name in (*self.files, self.mesh):
            if Path(name).name != name or not name.isprintable():
                return f"files, mesh: {name!r:.70} is no file's name"
        scenes = [link.scene for link in self.all_links]
        for name in (*scenes, *(sampler.file for sampler in self.samplers)):
            if name not in self.files:
                return f"files has no SHA-256 of {name!r:.70}"
        for name in self.auto:
            if name not in {*ANALYTIC, *(sampler.name for sampler in self.samplers)}:
                return f"auto: no such proposal or sampler: {name!r:.70}"
        return ""


def parse(text: bytes, path: Path) -> Manifest:
    """What `bundle.json` says, which `path` names in messages.

    Raises:
        SetupError: it is damaged, or was made by another version.
    """
    faults: list[str] = []
    try:
        info = json.loads(text)
        found = info.get("format") if isinstance(info, dict) else None
        if found != FORMAT:
            raise ValueError(f"is of format {found!r:.70}, not {FORMAT}: of another taxeld")
    except (ValueError, RecursionError) as error:
        raise SetupError(f"{path}: {reason(error)}; {AGAIN}") from None
    made = gate.take(Manifest, info, faults)
    if made is None or made.fault:
        raise SetupError(f"{path}: {made.fault if made else faults[0]}; {AGAIN}")
    return made


def read(path: Path) -> bytes:
    """Raises SetupError where the file is missing, unreadable or too large."""
    try:
        return files.read(path)
    except OSError as error:
        raise SetupError(f"{path}: {error.strerror}; {AGAIN}") from None


def unbroken(path: Path, digests: dict[str, str]) -> dict[str, bytes]:
    """The content of the files {name: SHA-256} in a directory.

    Raises:
        SetupError: one is missing, or has another digest.
    """
    found = {name: read(path / name) for name in digests}
    for name, data in found.items():
        if digest(data) != digests[name]:
            raise SetupError(
                f"{path / name}: is damaged or was changed: its SHA-256 is not that of "
                "bundle.json; copy or build the bundle again"
            )
    return found


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def reason(error: Exception) -> str:
    """A parser's message, as a part of one line."""
    return str(error).partition("\n")[0] or type(error).__name__


def save_scene(scene: Scene, path: Path) -> None:
    """Write `scene.npz`."""
    arrays = {name: np.asarray(getattr(scene, name)) for name in Scene.__dataclass_fields__}
    np.savez_compressed(path, allow_pickle=False, **arrays)


def parse_scene(data: bytes, path: Path) -> Scene:
    """The scene in the content of `scene.npz`, named by `path` in messages.

    Raises:
        SetupError: it is damaged, or not a scene.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as unpacked:
            if (size := sum(each.file_size for each in unpacked.infolist())) > files.LARGEST:
                raise ValueError(f"its arrays take {size} bytes, and may take {files.LARGEST}")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            needed = (k for k in Scene.__dataclass_fields__ if k in arrays or k != "islands")
            values = {name: arrays[name] for name in needed}
        cell, symmetry = float(values.pop("cell").item()), int(values.pop("symmetry").item())
        return Scene(**values, cell=cell, symmetry=symmetry)
    except Exception as error:  # exceptions of zip, zlib and numpy's headers share no base
        raise SetupError(f"{path}: unusable scene ({reason(error)}); {AGAIN}") from None
