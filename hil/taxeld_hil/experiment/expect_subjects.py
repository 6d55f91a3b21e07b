"""What `taxeld-hil expect` tries: an object on a skin; the same on a larger patch and on deeper
foam; and a skin whose taxels' responses are known.

A shipped or built bundle serves where it has this height and depth, also on another layout.
Otherwise one is written of the object's mesh, and the daemon looks up simulated contacts.
"""

import hashlib
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from taxeld.arrays import Floats
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.layout.read import COLUMNS
from taxeld.proposals import bundle
from taxeld.skin.calibration import Calibration
from taxeld_hil.experiment.measurement import code
from taxeld_hil.objects import HEIGHT_M
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario import scenario as scenarios
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.bundled import mesh_of, solid_of
from taxeld_hil.world.physics import MeshPhysics
from taxeld_hil.world.world import load_model
from taxeld_protocol.modules import MAX_MODULES

DEEPER = 2.0  # times the depth
DEPTHS_M = (1e-4, 0.05)  # limits, as of skin.full_scale_depth_m
ROBOT_MAX_M = 0.05
BELOW_M = 0.005  # under the lowest taxel: a skin is wider than its taxels
# (noise_sigma, gain_cv) that calibrations of these skins find; the mean of two runs each
LEFT = {"typical": (0.058, 0.08), "poor": (0.058, 0.09), "stiff": (0.028, 0.08)}
LEFT_OF_SCENE = (0.02, 0.02)


@dataclass(frozen=True)
class Asked:
    """The arguments; None is the object's own or the usual."""

    object: str  # a bundle, a YCB id or a mesh file
    layout: str = ""
    foam: str = ""
    robot_m: float = 0.001
    height_m: float | None = None
    depth_m: float | None = None


@dataclass(frozen=True)
class Found:
    """An object and a skin."""

    bundle: str  # empty: there is none
    mesh: str  # a YCB id or a file
    layout: str  # as `skin.layout`
    height_m: float | None  # at which the bundle was built
    depth_m: float


def subjects(asked: Asked, place: Path) -> dict[str, Scenario]:
    """Scenarios by name: `as it is`, `larger patch`, `deeper foam`. Bundles and layouts that are
    made for them are kept in `place`.

    Raises:
        SetupError: there is no such object, layout or foam, or one does not go with the other.
    """
    if not 0.0 <= asked.robot_m <= ROBOT_MAX_M:
        most = 1e3 * ROBOT_MAX_M
        raise SetupError(f"--robot-mm: must be 0..{most:g}, not {1e3 * asked.robot_m:g}")
    demo = replace(scenarios.load("demo").on(asked.foam), robot_m=asked.robot_m)
    found = _found(asked)
    layout = layouts.load(found.layout)
    height_m = _height_m(found, layout) if asked.height_m is None else asked.height_m
    depth_m = found.depth_m if asked.depth_m is None else asked.depth_m
    if not DEPTHS_M[0] <= depth_m <= DEPTHS_M[1]:
        raise SetupError(f"--depth-mm: must be 0.1..50, not {1e3 * depth_m:g}")
    made = {"as it is": _of(demo, found, found.layout, height_m, depth_m, place)}
    if 2 * len(np.unique(layout.uid >> 4)) <= MAX_MODULES:
        spec = _doubled(layout, place)
        rise_m = -layouts.load(spec).position_m[:, 2].min() + layout.position_m[:, 2].min()
        made["larger patch"] = _of(demo, found, spec, height_m + rise_m, depth_m, place)
    if DEEPER * depth_m <= DEPTHS_M[1]:
        made["deeper foam"] = _of(demo, found, found.layout, height_m, DEEPER * depth_m, place)
    for subject in made.values():
        model = load_model(subject)  # also whether the skin misses the object
        if subject.physics != "scene":  # built here once, before several workers need it
            solid_of(subject.bundle, model.layout)
    return made


def known_responses(scenario: Scenario, seed: int) -> Calibration:
    """The calibration of the very skin that this seed draws, as exact as one can be."""
    rig = Rig(scenario, seed)
    physics, zeros = rig.world.physics, np.zeros(len(rig.model.layout))
    noise_sigma, gain_cv = LEFT.get(scenario.physics, LEFT_OF_SCENE)
    own: Floats = physics.full_scale  # type: ignore[attr-defined]  # both kinds have it
    soft = isinstance(physics, MeshPhysics)
    return Calibration(
        t=0.0,
        digest="",
        object=scenario.bundle,
        presses=0,
        full_scale_depth_m=rig.model.depth_max_m,
        full_scale_counts=scenario.full_scale_counts,
        full_scale_sd=0.0,
        bend=scenario.skin.bend if soft else 0.0,
        bend_sd=0.0,
        mount=np.zeros(3),
        mount_sd=np.zeros(3),
        noise_sigma=noise_sigma,
        gain_cv=gain_cv,
        gain=own / scenario.full_scale_counts,
        gain_sd=zeros,
        onset=physics.response.steeper if isinstance(physics, MeshPhysics) else zeros,
        onset_sd=zeros,
        noise_counts=scenario.skin.noise_counts[0] + zeros,
        frozen=zeros > 0.0,
    )


def _found(asked: Asked) -> Found:
    is_bundle = False
    with suppress(SetupError):
        is_bundle = bundle.find(asked.object).is_dir()
    if is_bundle:
        built = bundle.manifest_of(asked.object)
        mesh = mesh_of(asked.object, built)
        layout = asked.layout or Scenario(asked.object).skin_layout
        return Found(asked.object, mesh, layout, built.height_m, built.depth_max_m)
    from taxeld_hil.objects import meshes  # noqa: PLC0415  (needs trimesh, an extra)

    try:
        meshes.find(asked.object)
    except SetupError as error:
        raise SetupError(f"--object: {error}; or a bundle: box, drill, mug, or a path") from None
    skin = SkinConfig()
    return Found("", asked.object, asked.layout or skin.layout, None, skin.full_scale_depth_m)


def _height_m(found: Found, layout: Layout) -> float:
    """The bundle's height, or more where the skin would reach below the object."""
    usual = found.height_m or HEIGHT_M
    if found.bundle and bundle.manifest_of(found.bundle).layout.digest == layout.digest:
        return usual
    least_m = float(np.ceil(1e3 * (BELOW_M - layout.position_m[:, 2].min()))) / 1e3
    return max(usual, least_m)


def _of(
    base: Scenario, found: Found, spec: str, height_m: float, depth_m: float, place: Path
) -> Scenario:
    """The scenario with an object on a layout: of a bundle that has this height and depth, or of
    one that is written for it unless it is there."""
    base = base.on("", spec)
    if found.bundle and (height_m, depth_m) == (found.height_m, found.depth_m):
        return replace(base, bundle=found.bundle)
    from taxeld_hil.objects import bundles  # noqa: PLC0415  (needs trimesh, an extra)

    mesh, layout = found.mesh, layouts.load(spec)
    file = Path(mesh)
    raw = file.read_bytes() if file.suffix else b""
    key = f"{code()} {mesh} {layout.digest} {height_m:.6f} {depth_m:.6f}".encode() + raw
    out = place / f"{file.stem}-{hashlib.sha256(key).hexdigest()[:12]}"
    if not out.is_dir():
        with bundles.replacing(out) as made:
            bundles.write(mesh, [(layout, height_m)], depth_m, made)
    return replace(base, bundle=str(out))


def _doubled(layout: Layout, place: Path) -> str:
    """The path of a table of a patch of two such layouts, one above the other."""
    position, (modules, module) = layout.position_m, np.unique(layout.uid >> 4, return_inverse=True)
    gap = np.linalg.norm(position[:, None] - position, axis=2) + 1e3 * np.eye(len(layout))
    step_m = float(np.ptp(position[:, 2]) + np.median(gap.min(axis=1)))
    lines = [",".join([*COLUMNS, "uid"])]
    for k in range(2):
        uid = (module + 1 + k * len(modules)) << 4 | layout.uid & 0xF
        rows = np.hstack([position + np.array([0.0, 0.0, k * step_m]), layout.normal])
        for row, own in zip(rows, uid, strict=True):
            lines.append(",".join([*(f"{v:.7f}" for v in row), str(own)]))
    text = "\n".join([*lines, ""])
    place.mkdir(parents=True, exist_ok=True)
    stem = Path(layout.name.split(":")[0]).stem
    path = place / f"{stem}-2-{hashlib.sha256(text.encode()).hexdigest()[:12]}.csv"
    path.write_text(text, encoding="ascii")
    return str(path)
