"""The solid that a bundle was made of: the mesh itself, not the slices that a daemon has of it."""

import numpy as np

from taxeld.layout.layout import Layout
from taxeld.proposals import bundle
from taxeld_hil.world import meshes
from taxeld_hil.world.mesh_skin import LAYER_M, MARGIN_M
from taxeld_hil.world.solids import Solid


def solid_of(name: str, layout: Layout) -> Solid:
    """The solid that the bundle `name` was made of, at the bundle's height.

    Raises:
        SetupError: the bundle is damaged, or its mesh cannot be found or read.
    """
    built = bundle.manifest_of(name)
    reach = float(np.abs(layout.position_m[:, 2]).max()) + MARGIN_M + LAYER_M
    mesh = str(bundle.find(name) / built.mesh) if built.mesh else built.object
    return meshes.load(mesh, built.height_m, reach)
