"""Scene bundles: a directory with the scene, its samplers, and their description."""

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals import manifest
from taxeld.proposals.analytic import ANALYTIC, Table, check_contacts
from taxeld.proposals.manifest import LinkEntry, Manifest, SamplerEntry

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
    def order(self) -> tuple[str, ...]:
        """Proposals by preference, the first choice of `auto` first."""
        return self.manifest.auto or (Table.name,)

    @property
    def choices(self) -> list[str]:
        """All proposals that `auto` may choose on any machine. A sampler with as many operations as
        one preferred to it, or more, is left out: it would not be faster."""
        samplers, least, kept = self._samplers(), float("inf"), []
        for name in self.order:
            if name not in samplers or samplers[name].flops < least:
                kept.append(name)
                least = samplers[name].flops if name in samplers else least
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
        from taxeld.proposals.sampler import Sampler  # noqa: PLC0415  (it loads onnxruntime)

        return Sampler(self.files[entry.file], self.model.layout, entry.kind, path)

    def own(self, name: str) -> str:
        """The name, or the table's where there is no such sampler."""
        return name if name in self._samplers() or name in ANALYTIC else Table.name

    def proposal(self, name: str) -> Proposal:
        """The proposal that `filter.proposal` names, by the rules of `resolve`."""
        return self.open(self.resolve(name))

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
    folder = Path(str(resources.files("taxeld") / "bundles"))
    return {path.parent.name: path.parent for path in folder.glob(f"*/{manifest.NAME}")}


def load(
    name: str,
    layout: Layout,
    depth_max_m: float | None = None,
    key: str = KEY,
    further: Sequence[Layout] = (),
) -> Bundle:
    """Load and validate a bundle for a skin, at the depth that it was built for; `key` of the
    configuration names it. `further`: the layouts of further links.

    Raises:
        SetupError: it is missing, damaged, or of another layout, or of another depth than given.
    """
    path = find(name, key)
    found, info = manifest.parse(manifest.read(path / manifest.NAME), path / manifest.NAME)
    links = _links(path, found, (layout, *further), key)
    check_depth(path.name, found, depth_max_m)
    files = manifest.unbroken(path, found.files)
    first, *more = (
        _model(path / link.scene, files[link.scene], each, found.depth_max_m)
        for link, each in zip(links, (layout, *further), strict=True)
    )
    if more:
        first = ObservationModel(first.scene, layout, found.depth_max_m, more)
    if links[0].scene != manifest.SCENE:  # the samplers are of another link
        at, height_m = links[0].layout, links[0].height_m
        found = replace(found, layout=at, height_m=height_m, samplers=(), auto=(Table.name,))
    return Bundle(path, found, info, files, first)


def _links(path: Path, found: Manifest, layouts: Sequence[Layout], key: str) -> list[LinkEntry]:
    """The links of a bundle that belong to the layouts; links of one layout take its scenes in
    their order, and the last serves all others.

    Raises:
        SetupError: there is none of a layout.
    """
    taken, links = Counter[str](), list[LinkEntry]()
    for layout in layouts:
        fit = [link for link in found.all_links if link.layout.digest == layout.digest]
        if not fit:
            built = [f"{link.layout.name} ({link.layout.digest})" for link in found.all_links]
            cure = (
                "name that layout (skin.layout, or --layout), or build a bundle for this one "
                "('taxeld-train build --layout')"
            )
            if len(layouts) > 1:
                cure = "build it for all links ('taxeld-train build', with a --layout for each)"
            s = "s" * (len(built) != 1)
            raise SetupError(
                f"{key}: {path.name} is for the layout{s} {' and '.join(built)}, "
                f"not for {layout.name} ({layout.digest}); {cure}"
            )
        links.append(fit[min(taken[layout.digest], len(fit) - 1)])
        taken[layout.digest] += 1
    return links


def _model(path: Path, data: bytes, layout: Layout, depth_max_m: float) -> ObservationModel:
    """The model of the scene in the file at `path` on a layout. Raises SetupError."""
    scene = manifest.parse_scene(data, path)
    try:
        model = ObservationModel(scene, layout, depth_max_m)
        check_contacts(model)
    except SetupError as error:
        raise SetupError(f"{path}: {error}") from None
    return model


def check_depth(name: str, found: Manifest, depth_max_m: float | None) -> None:
    """Raises SetupError where the bundle `name` was built for another depth than the one given."""
    if depth_max_m is not None and abs(found.depth_max_m - depth_max_m) > DEPTH_ALIKE_M:
        raise SetupError(
            f"skin.full_scale_depth_m: is {depth_max_m:g}, but {name} was built for "
            f"{found.depth_max_m:g}; set it to that"
        )
