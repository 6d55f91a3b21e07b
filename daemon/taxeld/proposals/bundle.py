"""Scene bundles: a directory with the scene, its samplers, and their description."""

import contextlib
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from taxeld.config.tables import FilterConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals import manifest, scene_file
from taxeld.proposals.analytic import ANALYTIC, Table, check_contacts
from taxeld.proposals.ladder import Ladder, Rung, Step
from taxeld.proposals.manifest import Manifest, SamplerEntry
from taxeld.proposals.sampler import Sampler

KEY = "scene.bundle"  # of the configuration, which names a bundle
DEPTH_ALIKE_M = 1e-6  # depths that differ less are one


@dataclass(frozen=True, slots=True)
class Bundle:
    """A validated bundle that belongs to the configured layout."""

    path: Path
    manifest: Manifest
    info: dict[str, Any]  # the whole content of bundle.json
    files: dict[str, bytes]  # name → content of each file beside bundle.json
    model: ObservationModel

    def resolve(self, name: str) -> str:
        """The analytic proposal or the sampler that `filter.proposal` names.

        A kind of sampler (`density`, `ddpm`) is the bundle's first of that kind, and `auto` the
        bundle's first choice, whatever it costs on this machine.

        Raises:
            SetupError: the bundle has none of that name.
        """
        samplers = self._samplers()
        if name in ANALYTIC or name in samplers:
            return name
        if name == "auto":
            return self.order[0]
        for entry in samplers.values():
            if entry.kind == name:
                return entry.name
        known = ", ".join(dict.fromkeys(["auto", *ANALYTIC, *samplers]))
        raise SetupError(f"filter.proposal: {self.path.name} has no '{name}'; it has {known}")

    @property
    def order(self) -> list[str]:
        """Proposals by preference, the first choice of `auto` first."""
        return self.manifest.auto or [Table.name]

    @property
    def choices(self) -> list[str]:
        """All proposals that `auto` may choose on any machine. A sampler with more operations than
        one preferred to it is left out: it would not be faster."""
        return self._lighter(math.inf)

    def cheaper(self, name: str) -> list[str]:
        """Samplers with fewer operations than the sampler `name`, by preference, each with fewer
        than the one before."""
        samplers = self._samplers()
        most = samplers[name].flops if name in samplers else 0.0
        return [n for n in self._lighter(most) if n in samplers]

    def _lighter(self, most: float) -> list[str]:
        """Proposals of `order`: analytic ones, and samplers that each have fewer operations than
        the one before, below `most`."""
        samplers = self._samplers()
        kept = []
        for name in self.order:
            if name in samplers:
                if samplers[name].flops >= most:
                    continue
                most = samplers[name].flops
            kept.append(name)
        return kept

    def open(self, name: str) -> Proposal:
        """An analytic proposal or a sampler by its own name.

        Raises:
            SetupError: the sampler cannot be used.
        """
        if name in ANALYTIC:
            return ANALYTIC[name](self.model)
        entry = self._samplers()[name]
        path = self.path / entry.file
        return Sampler(self.files[entry.file], self.model.layout, entry.kind, path)

    def own(self, name: str) -> str:
        """The name, or the table's where there is no such sampler."""
        return name if name in self._samplers() or name in ANALYTIC else Table.name

    def proposal(self, name: str) -> Proposal:
        """The proposal that `filter.proposal` names, by the rules of `resolve`."""
        return self.open(self.resolve(name))

    def untimed(self, config: FilterConfig) -> Ladder:
        """As `several.untimed`, of this bundle alone."""
        return Ladder([Rung(Step.CHOSEN, self.proposal(config.proposal))])

    def _samplers(self) -> dict[str, SamplerEntry]:
        return {sampler.name: sampler for sampler in self.manifest.samplers}


def is_shipped(name: str) -> bool:
    return name in _shipped()


def find(name: str, key: str = KEY) -> Path:
    """The directory of a shipped bundle's name or of a path; `key` is what names it."""
    shipped = _shipped()
    if name in shipped:
        return shipped[name]
    with contextlib.suppress(OSError, ValueError):  # no path, or one where this user may not look
        if (Path(name) / manifest.NAME).is_file():
            return Path(name)
    raise SetupError(
        f"{key}: no bundle {name!r:.100}; shipped are {', '.join(sorted(shipped))}; "
        "others are built by 'taxeld-train build'"
    )


def manifest_of(name: str) -> Manifest:
    """The manifest of a shipped bundle's name or of a path. Raises SetupError."""
    path = find(name) / manifest.NAME
    return manifest.parse(manifest.read(path), path)[0]


def _shipped() -> dict[str, Path]:
    """The shipped bundles by their names."""
    folder = Path(str(resources.files("taxeld") / "bundles"))
    return {path.parent.name: path.parent for path in folder.glob(f"*/{manifest.NAME}")}


def load(name: str, layout: Layout, depth_max_m: float | None = None, key: str = KEY) -> Bundle:
    """Load and validate a bundle for a skin, at the depth that it was built for; `key` of the
    configuration names it.

    Raises:
        SetupError: it is missing, damaged, or of another layout, or of another depth than given.
    """
    path = find(name, key)
    found, info = manifest.parse(manifest.read(path / manifest.NAME), path / manifest.NAME)
    if found.layout.digest != layout.digest:
        raise SetupError(
            f"{key}: {path.name} is for the layout {found.layout.name} "
            f"({found.layout.digest}), not for {layout.name} ({layout.digest}); name that layout "
            "(skin.layout, or --layout), or build a bundle for this one "
            "('taxeld-train build --layout')"
        )
    check_depth(path.name, found, depth_max_m)
    files = manifest.unbroken(path, found.files)
    scene = scene_file.parse(files[manifest.SCENE], path / manifest.SCENE)
    try:
        model = ObservationModel(scene, layout, found.depth_max_m)
        check_contacts(model)
    except SetupError as error:
        raise SetupError(f"{path / manifest.SCENE}: {error}") from None
    return Bundle(path, found, info, files, model)


def check_depth(name: str, found: Manifest, depth_max_m: float | None) -> None:
    """Raises SetupError where the bundle `name` was built for another depth than the one given."""
    if depth_max_m is not None and abs(found.depth_max_m - depth_max_m) > DEPTH_ALIKE_M:
        raise SetupError(
            f"skin.full_scale_depth_m: is {depth_max_m:g}, but {name} was built for "
            f"{found.depth_max_m:g}; set it to that"
        )
