"""`taxeld-train build`: an object and a skin → a bundle that the daemon runs.

Several models are trained, all are measured against the exact posterior beside the analytic
proposals, and the cheapest that is as good as the best becomes what the daemon runs by default: a
can of revolution must not cost what a drill costs.
"""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch

from taxeld import bundle
from taxeld.config import SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import Layout
from taxeld.observation import Noise, ObservationModel
from taxeld.sampler import Sampler
from taxeld_training import export, meshes, quality, scenes, variants
from taxeld_training.dataset import Touches, simulate
from taxeld_training.models import Model
from taxeld_training.scene_error import grid_error
from taxeld_training.variants import Variant

HEIGHT_M = 0.04  # the sensor frame's origin above the object's lowest point
DEPTH_MAX_M = SkinConfig().full_scale_depth_m
MEASURED_READINGS = 48
TOLERANCE = 1.15  # times the best distance: what counts as as good as the best
VARIANTS = (variants.density(64), variants.diffusion(), variants.density(16, 48, 2))


@dataclass(frozen=True)
class BuildConfig:
    """All that a bundle depends on beside its mesh and layout."""

    height_m: float = HEIGHT_M
    depth_max_m: float = DEPTH_MAX_M
    variants: tuple[Variant, ...] = VARIANTS
    noise: Noise = field(default_factory=Noise)
    bank: int = quality.BANK
    workers: int = 2
    seed: int = 0


Progress = Callable[[str, float], None]  # stage, share of it done


def build(name: str, layout: Layout, config: BuildConfig, out: Path, progress: Progress) -> Path:
    """Build the bundle of `name` (a YCB id or a mesh file) for `layout` in the directory `out`.

    `out` is replaced only when all of it is there.

    Raises:
        SetupError: the object or skin cannot be used, or `out` is something else's.
    """
    if out.exists() and not (out / "bundle.json").is_file() and any(out.iterdir()):
        raise SetupError(f"--out: {out} is a directory with other content; name an empty one")
    path, attribution = meshes.find(name)
    mesh = meshes.load(path)
    scene = scenes.build(mesh, layout, config.height_m)
    error = grid_error(scene, mesh, layout, config.height_m, config.depth_max_m)
    model = ObservationModel(scene, layout, config.depth_max_m)
    rng = np.random.default_rng(config.seed)
    touches = simulate(model, max(v.training.contacts for v in config.variants), rng)
    progress("contacts", 1.0)
    trained = _train(config, model, touches, progress)
    to = quality.reference(model, config.noise, MEASURED_READINGS, rng, bank=config.bank)
    progress("exact posterior", 1.0)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as temporary:
        made = Path(temporary) / "bundle"
        made.mkdir()
        scene.save(made / "scene.npz")
        samplers: list[dict[str, Any]] = []
        for done, (variant, network) in enumerate(trained, 1):
            samplers += _samplers(variant, network, config, model, made, to)
            progress("samplers", done / len(trained))
        analytic = {
            name: _measured(make(model), to, config.seed) for name, make in bundle.ANALYTIC.items()
        }
        choice = choose({s["name"]: s for s in samplers} | analytic, TOLERANCE)
        samplers.sort(key=lambda s: choice["order"].index(s["name"]))
        info = {
            "format": bundle.FORMAT,
            "object": path.stem,
            "attribution": attribution,
            "layout": {"name": layout.name, "digest": layout.digest},
            "height_m": config.height_m,
            "depth_max_m": config.depth_max_m,
            "symmetry": scene.symmetry,
            "repairs": scenes.repairs(mesh, layout, config.height_m),
            "grid_error_mm": asdict(error),
            "contacts_dropped_share": touches.dropped_share,
            "noise": asdict(config.noise),
            "samplers": samplers,
            "analytic": analytic,
            "energy_floor": to.floor,
            "auto": choice["order"],
            "choice": choice["why"],
            "measured": (
                f"mean energy distance of {quality.SAMPLES} samples to as many exact draws over "
                f"{len(to.z)} simulated readings ({to.left_out} left out: effective bank under "
                f"{quality.LIMIT_ESS:g} of {to.bank}), turns weighed at {to.length_m:.4f} m; "
                f"the exact draws' own error is {to.error:.3f} posterior sd; ms is CPU time for "
                f"{quality.SAMPLES} samples on one thread"
            ),
        }
        (made / "bundle.json").write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")
        _replace(made, out)
    return out


def choose(candidates: dict[str, dict[str, Any]], tolerance: float) -> dict[str, Any]:
    """The order in which the daemon prefers proposals {name: {energy_distance, ms}}, and why.

    First the cheapest whose distance is within `tolerance` times the best; then the others by
    distance.
    """
    best = min(candidates, key=lambda name: candidates[name]["energy_distance"])
    limit = tolerance * candidates[best]["energy_distance"]
    good = [name for name, c in candidates.items() if c["energy_distance"] <= limit]
    first = min(good, key=lambda name: candidates[name]["ms"])
    rest = sorted(candidates.keys() - {first}, key=lambda n: candidates[n]["energy_distance"])
    chosen, nearest = candidates[first], candidates[best]
    why = (
        f"{first} is the cheapest ({chosen['ms']:.2f} ms) within {tolerance:g} × the least "
        f"distance to the exact posterior ({nearest['energy_distance']:.4f}, {best}, "
        f"{nearest['ms']:.2f} ms)"
    )
    return {"order": [first, *rest], "why": why}


def _train(
    config: BuildConfig, model: ObservationModel, touches: Touches, progress: Progress
) -> list[tuple[Variant, Model]]:
    """All variants, side by side, one thread each; the longest first."""
    jobs = (
        joblib.delayed(_fit)(variant, model, config.noise, touches) for variant in config.variants
    )
    done: list[Model] = []
    workers = min(config.workers, len(config.variants))
    parallel = joblib.Parallel(workers, return_as="generator", mmap_mode="c")
    for network in parallel(jobs):
        done.append(network)
        progress("training", len(done) / len(config.variants))
    return list(zip(config.variants, done, strict=True))


def _fit(variant: Variant, model: ObservationModel, noise: Noise, touches: Touches) -> Model:
    torch.set_num_threads(1)
    return variants.fit(variant, model, noise, touches, lambda _update, _loss: None)


def _samplers(
    variant: Variant, network: Model, config: BuildConfig, model: ObservationModel, made: Path,
    to: quality.Reference,
) -> Sequence[dict[str, Any]]:  # fmt: skip
    """Export what a trained model can be run as into `made`, measure it, and describe it."""
    found = []
    for name, sampler in variants.samplers(variant, network).items():
        path = made / f"{name}.onnx"
        metadata = variant.describe() | {
            "noise": asdict(config.noise),
            "layout": model.layout.digest,
            "normalisation": {k: getattr(network, k).tolist() for k in ("mean", "scale")},
        }
        export.export(sampler, len(model.layout), path, metadata)
        found.append({
            "name": name,
            "kind": variant.kind,
            "file": path.name,
            "steps": sampler.steps,
            "width": network.config.width,
            "flops": export.flops(sampler, quality.SAMPLES),
            **_measured(Sampler(path, model.layout, variant.kind), to, config.seed),
        })  # fmt: skip
    return found


def _measured(proposal: Any, to: quality.Reference, seed: int) -> dict[str, float]:
    rng = np.random.default_rng(seed)
    return {
        "energy_distance": quality.distance(proposal, to, rng),
        "ms": quality.cost_ms(proposal, to, rng),
    }


def _replace(made: Path, out: Path) -> None:
    """Put the finished directory in place of an older bundle."""
    if out.is_dir():
        for file in out.iterdir():
            file.unlink()
        out.rmdir()
    made.rename(out)
