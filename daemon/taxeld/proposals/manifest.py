"""`bundle.json`: the description of a bundle, and the digests of its other files.

Each file is read once: the compared bytes are the ones that are parsed.
"""

import hashlib
import json
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from taxeld import files
from taxeld.config.tables import FilterConfig
from taxeld.errors import SetupError
from taxeld.proposals.analytic import ANALYTIC

NAME = "bundle.json"
SCENE = "scene.npz"
FORMAT = 3  # version 2 had no digests
KINDS = ("density", "ddpm")  # kinds of samplers
LARGEST = 1e18  # limit of numbers
USUAL = FilterConfig()


@dataclass(frozen=True, slots=True)
class BuiltFor:
    """The layout for which a bundle was built."""

    name: str
    digest: str


@dataclass(frozen=True, slots=True)
class LinkEntry:
    """A further link for which a bundle was built."""

    layout: BuiltFor
    height_m: float
    scene: str  # the object at the heights of this link: a file


@dataclass(frozen=True, slots=True)
class SamplerEntry:
    """A sampler of a bundle."""

    name: str
    kind: str  # one of KINDS
    file: str
    flops: float  # operations of one call


@dataclass(frozen=True, slots=True)
class FilterEntry:
    """Numbers of particles and samples that were enough for the object when the bundle was built,
    as the configuration's keys of the same names."""

    particles: int = USUAL.particles
    particles_max: int = USUAL.particles_max
    injected: int = USUAL.injected


@dataclass(frozen=True, slots=True)
class Manifest:
    """The keys of `bundle.json` that the daemon and the harness use. Lengths in metres."""

    object: str
    layout: BuiltFor
    height_m: float
    depth_max_m: float
    files: dict[str, str]  # name → SHA-256 of each file beside bundle.json
    samplers: list[SamplerEntry]
    auto: list[str]  # proposals by preference
    links: list[LinkEntry] = field(default_factory=list)  # the first one's is `layout`
    mesh: str = ""  # a file of the bundle with the mesh, where the object is not one of YCB's
    filter: FilterEntry = field(default_factory=FilterEntry)

    def __post_init__(self) -> None:
        """Raises ValueError where the values do not belong together."""
        for name in (*self.files, self.mesh):
            if Path(name).name != name:
                raise ValueError(f"files, mesh: {name!r:.70} is no file's name")
        scenes = [link.scene for link in self.all_links]
        for name in (*scenes, *(sampler.file for sampler in self.samplers)):
            if name not in self.files:
                raise ValueError(f"files has no SHA-256 of {name!r:.70}")
        for sampler in self.samplers:
            if sampler.kind not in KINDS:
                raise ValueError(f"samplers: {sampler.kind!r:.70} is none of {', '.join(KINDS)}")
        for key, given in asdict(self.filter).items():
            fault = FilterConfig.__dataclass_fields__[key].metadata["check"](given)
            if fault:
                raise ValueError(f"filter.{key}: {fault}")
        for name in self.auto:
            if name not in {*ANALYTIC, *(sampler.name for sampler in self.samplers)}:
                raise ValueError(f"auto: no such proposal or sampler: {name!r:.70}")

    @property
    def all_links(self) -> list[LinkEntry]:
        """The links for which the bundle was built, the one that has the samplers first."""
        return [LinkEntry(self.layout, self.height_m, SCENE), *self.links]


def parse(text: bytes, path: Path) -> tuple[Manifest, dict[str, Any]]:
    """The used keys of `bundle.json`, and its whole content; `path` names it in messages.

    Raises:
        SetupError: it is damaged, or of another format.
    """
    try:
        info = json.loads(text)
        found = info.get("format") if isinstance(info, dict) else None
        if found != FORMAT:
            raise ValueError(
                f"is of format {found!r:.70}, not {FORMAT} ('taxeld-train seal' turns 2 into 3)"
            )
        return _checked(Manifest, info, ""), info
    except (ValueError, RecursionError) as error:
        raise SetupError(f"{path}: {reason(error)}; build the bundle again") from None


def read(path: Path) -> bytes:
    """Raises SetupError where the file is missing, unreadable or too large."""
    try:
        return files.read(path)
    except OSError as error:
        raise SetupError(f"{path}: {error.strerror}; build the bundle again") from None


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


def _checked(kind: Any, value: object, key: str) -> Any:
    """A JSON value as `kind`; raises ValueError with its key. Maps may hold more keys."""
    inner, origin = get_args(kind), get_origin(kind)
    if hasattr(kind, "__dataclass_fields__") and isinstance(value, dict):
        kinds, at = get_type_hints(kind), f"{key}." if key else ""
        due = {f.name for f in fields(kind) if f.default is f.default_factory is MISSING}
        names = [f.name for f in fields(kind) if f.name in value or f.name in due]
        return kind(**{name: _checked(kinds[name], value.get(name), at + name) for name in names})
    if origin is list and isinstance(value, list):
        return [_checked(inner[0], one, f"{key}[{i}]") for i, one in enumerate(value)]
    if origin is dict and isinstance(value, dict):
        return {_checked(str, k, key): _checked(str, v, f"{key}.{k}") for k, v in value.items()}
    if kind is str and isinstance(value, str) and value.isprintable():
        return value
    if kind is int and type(value) is int:
        return value
    if kind is float and isinstance(value, int | float) and abs(value) < LARGEST:
        return float(value)
    words = {str: "line of text", int: "whole number", float: "number", list: "list"}
    raise ValueError(f"{key} is missing or no {words.get(origin or kind, 'map')}")
