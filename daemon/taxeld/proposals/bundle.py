"""Scene bundles: directories with a scene, its samplers, and their description; those of all
objects that may be felt, in the order of their numbers."""

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import combinations
from pathlib import Path

from taxeld.config.tables import SIZES, Config, FilterConfig, SceneConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import Scene
from taxeld.proposals import manifest
from taxeld.proposals.analytic import ANALYTIC, Table, check_contacts
from taxeld.proposals.manifest import LinkEntry, Manifest

KEY = "scene.bundle"  # of the configuration, which names a bundle
DEPTH_ALIKE_M = 1e-6  # depths that differ less are one
OTHER = "other"  # taken among the names in messages, for none of them


@dataclass(frozen=True, slots=True)
class Bundle:
    """A validated bundle that belongs to the configured layout."""

    path: Path
    manifest: Manifest
    files: dict[str, bytes]  # name → content of each file beside bundle.json
    model: ObservationModel

    @property
    def name(self) -> str:
        """The object's name in messages."""
        return _name(self.manifest, self.path)

    @property
    def order(self) -> tuple[str, ...]:
        """Proposals by preference, the first choice of `auto` first."""
        return self.manifest.auto or (Table.name,)

    def resolve(self, name: str) -> str:
        """The analytic proposal or the sampler that `filter.proposal` names.

        A kind of sampler (`density`, `ddpm`) is the bundle's first of that kind, and `auto` the
        bundle's first choice, whatever it costs on this machine.

        Raises:
            SetupError: the bundle has none of that name.
        """
        samplers = self.manifest.samplers
        kinds = {entry.kind: entry.name for entry in reversed(samplers)}
        known = {"auto": self.order[0]} | {own: own for own in ANALYTIC}
        known |= {entry.name: entry.name for entry in samplers}
        found = known.get(name) or kinds.get(name)
        if found is None:
            raise SetupError(
                f"filter.proposal: {self.path.name} has no '{name}'; it has {', '.join(known)}"
            )
        return found

    def open(self, name: str) -> Proposal:
        """An analytic proposal or a sampler by its own name; the table where there is none.

        Raises:
            SetupError: the sampler cannot be used.
        """
        for entry in self.manifest.samplers:
            if entry.name == name:
                from taxeld.proposals.sampler import Sampler  # noqa: PLC0415  (loads onnxruntime)

                data, path = self.files[entry.file], self.path / entry.file
                return Sampler(data, self.model.layout, entry.kind, path)
        return ANALYTIC.get(name, Table)(self.model)

    def proposal(self, name: str) -> Proposal:
        """The proposal that `filter.proposal` names, by the rules of `resolve`."""
        return self.open(self.resolve(name))


def find(name: str, key: str = KEY) -> Path:
    """The directory of a shipped bundle's name or of a path; `key` is what names it."""
    path = shipped().get(name, Path(name))
    with contextlib.suppress(OSError):  # a directory where this user may not look
        if (path / manifest.NAME).is_file():
            return path
    raise SetupError(
        f"{key}: no bundle {name!r:.100}; shipped are {', '.join(sorted(shipped()))}; "
        "others are built by 'taxeld-train build'"
    )


def manifest_of(name: str, key: str = KEY) -> Manifest:
    """The manifest of a shipped bundle's name or of a path. Raises SetupError."""
    path = find(name, key) / manifest.NAME
    return manifest.parse(manifest.read(path), path)


def shipped() -> dict[str, Path]:
    """The directories of the bundles that come with taxeld, by name."""
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
    path, found = find(name, key), manifest_of(name, key)
    links = _links(path, found, (layout, *further), key)
    if depth_max_m is not None and abs(found.depth_max_m - depth_max_m) > DEPTH_ALIKE_M:
        raise SetupError(
            f"skin.full_scale_depth_m: is {depth_max_m:g}, but {path.name} was built for "
            f"{found.depth_max_m:g}; set it to that"
        )
    files = manifest.unbroken(path, found.files)
    models = []
    for link, each in zip(links, (layout, *further), strict=True):
        scene = manifest.parse_scene(files[link.scene], path / link.scene)
        try:
            models.append(ObservationModel(scene, each, found.depth_max_m))
            check_contacts(models[-1])
        except SetupError as error:
            raise SetupError(f"{path / link.scene}: {error}") from None
    model = models[0]
    if further:
        model = ObservationModel(model.scene, layout, found.depth_max_m, models[1:])
    if links[0].scene != manifest.SCENE:  # the samplers are of another link
        at, height_m = links[0].layout, links[0].height_m
        found = replace(found, layout=at, height_m=height_m, samplers=(), auto=(Table.name,))
    return Bundle(path, found, files, model)


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
                "('taxeld-train build', with a --layout for each link)"
            )
            raise SetupError(
                f"{key}: {path.name} is for the layout {' and '.join(built)}, "
                f"not for {layout.name} ({layout.digest}); {cure}"
            )
        links.append(fit[min(taken[layout.digest], len(fit) - 1)])
        taken[layout.digest] += 1
    return links


def load_all(
    scene: SceneConfig, layouts: Sequence[Layout], depth_max_m: float | None = None
) -> list[Bundle]:
    """Load and validate all bundles that a configuration names, as `load` does each, for the
    `layouts` of its links.

    Raises:
        SetupError: one cannot be used, or two do not belong together.
    """
    key = "scene.bundles" if scene.bundles else KEY
    of_all = [manifest_of(name, key) for name in scene.names]
    for (name, one), (again, two) in combinations(zip(scene.names, of_all, strict=True), 2):
        if one.object == two.object:
            raise SetupError(
                f"{key}: {name} and {again} are both of {one.object}; keep one of the two"
            )
        if abs(one.depth_max_m - two.depth_max_m) > DEPTH_ALIKE_M:
            raise SetupError(
                f"{key}: {name} was built for a depth of {one.depth_max_m:g} m, {again} for "
                f"{two.depth_max_m:g} m; build both for one ('taxeld-train build --depth-mm')"
            )
    return [load(name, layouts[0], depth_max_m, key, layouts[1:]) for name in scene.names]


def scenes(bundles: Sequence[Bundle]) -> dict[str, Scene]:
    """The scenes of the objects by their names in messages."""
    return {one.name: one.model.scene for one in bundles}


def names(scene: SceneConfig) -> tuple[str, ...]:
    """The names of a configuration's objects in messages. Raises SetupError."""
    return tuple(_name(manifest_of(name), find(name)) for name in scene.names)


def _name(found: Manifest, path: Path) -> str:
    return found.object if found.object != OTHER else f"{path.name}/{found.object}"


def sized(config: Config, found: Sequence[Manifest]) -> Config:
    """The configuration with as many particles and samples as were enough for the objects when
    their bundles were built, unless it says itself how many. Of several the most count."""
    if config.is_sized or not found:
        return config
    own = [one.filter.over(FilterConfig()) for one in found]
    most = {key: max(getattr(one, key) for one in own) for key in SIZES}
    return replace(config, filter=replace(config.filter, **most))
