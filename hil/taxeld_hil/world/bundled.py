"""What a bundle was made of, and the bundle's object on another skin."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle
from taxeld.proposals.analytic import Table, check_contacts
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.manifest import BuiltFor, Manifest
from taxeld_hil.world import meshes
from taxeld_hil.world.mesh_skin import LAYER_M, MARGIN_M
from taxeld_hil.world.solids import Solid


def solid_of(name: str, layout: Layout) -> Solid:
    """The solid that the bundle `name` was made of, at the bundle's height: the mesh itself, not
    the slices that a daemon has of it.

    Raises:
        SetupError: the bundle is damaged, or its mesh cannot be found or read.
    """
    built = bundle.manifest_of(name)
    reach = float(np.abs(layout.position_m[:, 2]).max()) + MARGIN_M + LAYER_M
    return meshes.load(mesh_of(name, built), built.height_m, reach)


def on_layout(name: str, *specs: str) -> Bundle:
    """The bundle `name` on a layout, as `skin.layout` has it, or on those of several links. Where
    it was built for others its object is cut anew at their heights, and the table proposes.

    Raises:
        SetupError: the bundle, the layout or the object's mesh cannot be found, read or used.
    """
    layout, *further = (layouts.load(spec) for spec in specs)
    built = {link.layout.digest for link in bundle.manifest_of(name).all_links}
    if {each.digest for each in (layout, *further)} <= built:
        return bundle.load(name, layout, further=further)
    return _cut_anew(name, *specs)


@lru_cache(maxsize=4)  # a scene takes seconds, and a worker's runs have few objects and layouts
def _cut_anew(name: str, *specs: str) -> Bundle:
    from taxeld_hil.objects import scenes  # noqa: PLC0415  (an extra)

    built = bundle.manifest_of(name)
    at = [(layouts.load(spec), built.height_m) for spec in specs]
    cuts = scenes.cut_all(mesh_of(name, built), at)
    pairs = zip(cuts, at, strict=True)
    model, *more = (ObservationModel(cut, on, built.depth_max_m) for cut, (on, _) in pairs)
    for one in (model, *more):
        check_contacts(one)
    if more:
        model = ObservationModel(model.scene, model.layout, built.depth_max_m, more)
    own = BuiltFor(model.layout.name, model.layout.digest)
    found = replace(built, layout=own, samplers=(), auto=(Table.name,))
    return Bundle(bundle.find(name), found, {}, model)


def mesh_of(name: str, built: Manifest) -> str:
    """A YCB id, or the path of the bundle's own mesh."""
    return str(bundle.find(name) / built.mesh) if built.mesh else built.object
