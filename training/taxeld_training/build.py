"""`taxeld-train build`: an object and a skin → a bundle that the daemon runs."""

import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from taxeld import bundle
from taxeld.errors import SetupError
from taxeld.layout import Layout
from taxeld.observation import Noise, ObservationModel
from taxeld.proposals import Projection
from taxeld.sampler import Ddpm
from taxeld_training import export, meshes, quality, scenes
from taxeld_training.dataset import Batches, simulate
from taxeld_training.diffusion import Denoiser, NetworkConfig, Sampler, flops
from taxeld_training.scene_error import grid_error
from taxeld_training.train import TrainConfig, train

DEPTH_MAX_M = 0.005
SAMPLER_STEPS = (10, 100)  # the default first: few-step DDIM, then the paper's DDPM-100
MEASURED_READINGS = 64


@dataclass(frozen=True)
class BuildConfig:
    """All that a bundle depends on beside its mesh and layout."""

    height_m: float = 0.04
    depth_max_m: float = DEPTH_MAX_M
    width: int = 128
    train: TrainConfig = field(default_factory=TrainConfig)
    noise: Noise = field(default_factory=Noise)


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
    rng = np.random.default_rng(config.train.seed)
    touches = simulate(model, config.train.contacts, rng)
    progress("contacts", 1.0)
    network = NetworkConfig(taxels=len(layout), width=config.width)
    denoiser = train(
        network,
        config.train,
        Batches(touches, model, config.noise, config.train.seed),
        lambda update, _: progress("training", update / config.train.updates),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as temporary:
        made = Path(temporary) / "bundle"
        made.mkdir()
        scene.save(made / "scene.npz")
        to = quality.reference(model, config.noise, MEASURED_READINGS, rng)
        progress("exact posterior", 1.0)
        samplers = []
        for steps in SAMPLER_STEPS:
            samplers.append(_sampler(denoiser, steps, config, model, made, to))
            progress("samplers", len(samplers) / len(SAMPLER_STEPS))
        baseline = quality.distance(Projection(model), to, rng)
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
            "energy_distance": {"floor": to.floor, "projection": baseline},
        }
        (made / "bundle.json").write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")
        _replace(made, out)
    return out


def _sampler(
    denoiser: Denoiser, steps: int, config: BuildConfig, model: ObservationModel, made: Path,
    to: quality.Reference,
) -> dict[str, object]:  # fmt: skip
    """Export one sampler into `made`, measure it, and describe it."""
    sampler = Sampler(denoiser, steps)
    name = f"ddpm-{steps}" if sampler.ancestral else f"ddim-{steps}"
    path = made / f"{name}.onnx"
    network = denoiser.config
    normalisation = {"mean": denoiser.mean.tolist(), "scale": denoiser.scale.tolist()}
    export.export(
        sampler,
        path,
        {
            "network": asdict(network),
            "training": asdict(config.train),
            "noise": asdict(config.noise),
            "normalisation": normalisation,
            "layout": model.layout.digest,
        },
    )
    rng = np.random.default_rng(config.train.seed)
    measured = quality.distance(Ddpm(path, model.layout), to, rng)
    return {
        "name": name,
        "file": path.name,
        "steps": steps,
        "width": network.width,
        "flops": flops(network, steps, quality.SAMPLES),
        "energy_distance": measured,
        "measured": (
            f"mean energy distance of {quality.SAMPLES} samples to as many exact draws over "
            f"{len(to.z)} simulated readings ({to.left_out} left out: effective bank under "
            f"{quality.LIMIT_ESS:g} of {quality.BANK}), turns weighed at {to.length_m:.4f} m"
        ),
    }


def _replace(made: Path, out: Path) -> None:
    """Put the finished directory in place of an older bundle."""
    if out.is_dir():
        for file in out.iterdir():
            file.unlink()
        out.rmdir()
    made.rename(out)
