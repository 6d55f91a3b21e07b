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


def on_layout(name: str, spec: str) -> Bundle:
    """The bundle `name` on the layout `spec`, as `skin.layout` has it. Where it was built for
    another layout its object is cut anew at this one's heights, and the table proposes.

    Raises:
        SetupError: the bundle, the layout or the object's mesh cannot be found, read or used.
    """
    layout = layouts.load(spec)
    if bundle.manifest_of(name).layout.digest == layout.digest:
        return bundle.load(name, layout)
    return _cut_anew(name, spec)


@lru_cache(maxsize=4)  # a scene takes seconds, and a worker's runs have few objects and layouts
def _cut_anew(name: str, spec: str) -> Bundle:
    from taxeld_hil.objects import scenes  # noqa: PLC0415  (an extra)

    layout, built = layouts.load(spec), bundle.manifest_of(name)
    scene = scenes.cut(mesh_of(name, built), layout, built.height_m)
    model = ObservationModel(scene, layout, built.depth_max_m)
    check_contacts(model)
    own = BuiltFor(layout.name, layout.digest)
    found = replace(built, layout=own, samplers=[], auto=[Table.name])
    return Bundle(bundle.find(name), found, {"object": built.object}, {}, model)


def mesh_of(name: str, built: Manifest) -> str:
    """A YCB id, or the path of the bundle's own mesh."""
    return str(bundle.find(name) / built.mesh) if built.mesh else built.object
