"""The bundles of all objects that may be felt, in the order of their numbers."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from taxeld.config.tables import SIZES, Config, FilterConfig, SceneConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.scene import Scene
from taxeld.proposals import bundle
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.manifest import Manifest
from taxeld.proposals.samples import Samples

OTHER = "other"  # taken among the names in messages, for none of them


def load(
    scene: SceneConfig, layouts: Sequence[Layout], depth_max_m: float | None = None
) -> list[Bundle]:
    """Load and validate all bundles that a configuration names, as `bundle.load` does each, for
    the `layouts` of its links.

    Raises:
        SetupError: one cannot be used, or two do not belong together.
    """
    if not scene.names:
        return []
    layout, *further = layouts
    if len(scene.names) == 1:
        key = "scene.bundles" if scene.bundles else "scene.bundle"
        return [bundle.load(scene.names[0], layout, depth_max_m, key, further)]
    key = "scene.bundles"
    paths = [bundle.find(name, key).resolve() for name in scene.names]
    for (name, path), (again, same) in combinations(zip(scene.names, paths, strict=True), 2):
        if path == same:
            raise SetupError(f"{key}: {name} and {again} are one bundle; name it once")
    found = [bundle.load(name, layout, None, key, further) for name in scene.names]
    for one, two in combinations(found, 2):
        a, b = one.manifest, two.manifest
        if a.object == b.object:
            raise SetupError(
                f"{key}: {one.path} and {two.path} are both of {a.object}; keep one of the two"
            )
        if abs(a.depth_max_m - b.depth_max_m) > bundle.DEPTH_ALIKE_M:
            raise SetupError(
                f"{key}: {one.path.name} was built for a depth of {a.depth_max_m:g} m, "
                f"{two.path.name} for {b.depth_max_m:g} m; build both for one "
                "('taxeld-train build --depth-mm')"
            )
    bundle.check_depth(found[0].path.name, found[0].manifest, depth_max_m)
    return found


def scenes(bundles: Sequence[Bundle]) -> dict[str, Scene]:
    """The scenes of the objects by their names in messages."""
    return {_name(one.manifest, one.path): one.model.scene for one in bundles}


def names(scene: SceneConfig) -> tuple[str, ...]:
    """The names of a configuration's objects in messages. Raises SetupError."""
    return tuple(_name(bundle.manifest_of(name), bundle.find(name)) for name in scene.names)


def _name(found: Manifest, path: Path) -> str:
    return found.object if found.object != OTHER else f"{path.name}/{found.object}"


def leading(bundles: Sequence[Bundle]) -> Bundle:
    """The bundle whose proposals are chosen from: the first with the most of them. An object that
    has none of the chosen name has the table."""
    return max(bundles, key=lambda one: len(one.order))


def sized(config: Config, found: Sequence[Manifest]) -> Config:
    """The configuration with as many particles and samples as were enough for the objects when
    their bundles were built, unless it says itself how many. Of several the most count."""
    if config.is_sized or not found:
        return config
    own = [one.filter.over(FilterConfig()) for one in found]
    most = {key: max(getattr(one, key) for one in own) for key in SIZES}
    return replace(config, filter=replace(config.filter, **most))


def untimed(bundles: Sequence[Bundle], config: FilterConfig) -> Samples:
    """The configured proposal without a clock: the same samples on any machine."""
    if not bundles:
        return Samples()
    name = leading(bundles).resolve(config.proposal)
    return Samples([one.open(one.own(name)) for one in bundles])
