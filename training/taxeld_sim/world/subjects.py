"""Objects by name: a bundle, a YCB id or a mesh file, on any layout, size and height."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle
from taxeld.proposals.analytic import Table, check_contacts
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.manifest import NAME, BuiltFor, Manifest
from taxeld_sim.objects import HEIGHT_M
from taxeld_sim.world import solids
from taxeld_sim.world.mesh_skin import LAYER_M, MARGIN_M
from taxeld_sim.world.solids import Solid


@dataclass(frozen=True)
class Subject:
    """An object."""

    name: str  # a bundle, a YCB id or a mesh file
    scale: float = 1.0  # of the object and of the height at which it is touched
    # the sensor frame's origin above the lowest point of the unscaled object; None: the bundle's
    height_m: float | None = None
    depth_m: float | None = None  # of a press at full scale; None: the bundle's or the usual
    sampler: str = ""  # an ONNX file, for a proposal that no bundle holds

    @property
    def manifest(self) -> Manifest | None:
        """The bundle's; None where it is none."""
        try:
            bundle.find(self.name)
        except SetupError:
            return None
        return bundle.manifest_of(self.name)

    @property
    def mesh(self) -> str:
        """A YCB id, or the path of a mesh file."""
        built = self.manifest
        if built is None:
            return self.name
        return str(bundle.find(self.name) / built.mesh) if built.mesh else built.object

    @property
    def files(self) -> list[Path]:
        """The files that say what it is: a bundle's manifest, a mesh, a sampler."""
        names = [self.sampler, self.name if self.manifest is None else ""]
        own = [] if self.manifest is None else [bundle.find(self.name) / NAME]
        return own + [Path(name) for name in names if name and Path(name).suffix]

    @property
    def own_height_m(self) -> float:
        """The sensor frame's origin above the object's lowest point."""
        built = self.manifest
        usual = HEIGHT_M if built is None else built.height_m
        return self.scale * (usual if self.height_m is None else self.height_m)

    @property
    def own_depth_m(self) -> float:
        """The depth of a press at full scale."""
        if self.depth_m is not None:
            return self.depth_m
        built = self.manifest
        return SkinConfig().full_scale_depth_m if built is None else built.depth_max_m

    @property
    def is_as_built(self) -> bool:
        """Whether its bundle is of this very size, height and depth."""
        built = self.manifest
        if built is None or self.scale != 1.0:
            return False
        return (self.own_height_m, self.own_depth_m) == (built.height_m, built.depth_max_m)


def _stamps(subject: Subject, specs: Iterable[str]) -> tuple[int, ...]:
    """When the files of an object and of layouts were written."""
    files = [*subject.files, *(Path(spec) for spec in specs if ":" not in spec)]
    return tuple(path.stat().st_mtime_ns for path in files if path.is_file())


def model_of(subject: Subject, *specs: str) -> ObservationModel:
    """The object on a layout, as `skin.layout` has it, or on those of several links.

    Raises:
        SetupError: the bundle, the layout or the object's mesh cannot be found, read or used.
    """
    return _model_of(subject, specs, _stamps(subject, specs))


@lru_cache(maxsize=32)  # a scene takes seconds; and a worker's runs have few objects and layouts
def _model_of(
    subject: Subject, specs: tuple[str, ...], _stamps: tuple[int, ...]
) -> ObservationModel:
    first, *further = on = [layouts.load(spec) for spec in specs]
    built = subject.manifest
    of_bundle = {at.layout.digest for at in built.all_links} if built is not None else set()
    if subject.is_as_built and {each.digest for each in on} <= of_bundle:
        return bundle.load(subject.name, first, further=further).model
    from taxeld_sim.objects import meshes, scenes  # noqa: PLC0415  (an extra)

    mesh = meshes.load(meshes.find(subject.mesh)[0]).apply_scale(subject.scale)
    cuts = scenes.build_all(mesh, [(layout, subject.own_height_m) for layout in on])
    own, *more = (
        ObservationModel(cut, layout, subject.own_depth_m)
        for cut, layout in zip(cuts, on, strict=True)
    )
    for one in (own, *more):
        check_contacts(one)
    return ObservationModel(own.scene, own.layout, own.depth_max_m, more) if more else own


def solid_of(subject: Subject, *specs: str) -> Solid:
    """The object itself, at the heights of these layouts: the mesh, not the slices that a daemon
    has of it.

    Raises:
        SetupError: the bundle is damaged, or its mesh cannot be found or read.
    """
    return _solid_of(subject, specs, _stamps(subject, specs))


@lru_cache(maxsize=8)
def _solid_of(subject: Subject, specs: tuple[str, ...], _stamps: tuple[int, ...]) -> Solid:
    places = np.vstack([layouts.load(spec).position_m for spec in specs])
    reach_m = math.ceil(1e3 * np.linalg.norm(places, axis=1).max()) / 1e3 + MARGIN_M + LAYER_M
    from taxeld_sim.objects import meshes  # noqa: PLC0415  (an extra)

    path, _ = meshes.find(subject.mesh)
    return solids.load(path, subject.own_height_m, reach_m, subject.scale)


def on_layout(name: str, *specs: str) -> Bundle:
    """The bundle `name` on a layout, or on those of several links. Where it was built for others
    its object is cut anew at their heights, and the table proposes. Raises SetupError."""
    first, *further = (layouts.load(spec) for spec in specs)
    built = bundle.manifest_of(name)
    if {each.digest for each in (first, *further)} <= {at.layout.digest for at in built.all_links}:
        return bundle.load(name, first, further=further)
    model = model_of(Subject(name), *specs)
    own = BuiltFor(first.name, first.digest)
    found = replace(built, layout=own, samplers=(), auto=(Table.name,))
    return Bundle(bundle.find(name), found, {}, model)
