"""Proposals of the experiments: analytic ones, a density, shipped or trained once, and the paper's
own diffusion.
"""

from functools import lru_cache
from importlib import resources
from pathlib import Path

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals import bundle
from taxeld.proposals.analytic import ANALYTIC
from taxeld.proposals.sampler import Sampler
from taxeld_training.models.variants import MODELS
from taxeld_training.objects.setting import DEPTH_MAX_M, Setting

DENSITY, PAPER = "density", "paper"
LEARNED = {DENSITY: MODELS["density-64"], PAPER: MODELS["paper"]}


@lru_cache(maxsize=8)
def shipped(setting: Setting) -> bundle.Bundle | None:
    """The bundle of the setting's object and skin, if one is shipped."""
    if not setting.is_as_shipped:
        return None
    layout = layouts.load(setting.skin)
    for path in sorted(Path(str(resources.files("taxeld") / "bundles")).iterdir()):
        try:
            found = bundle.load(path.name, layout, DEPTH_MAX_M)
        except SetupError:  # no bundle, or of another skin
            continue
        if found.info["object"] == setting.object:
            return found
    return None


def shipped_with(setting: Setting) -> bundle.Bundle:
    """The same.

    Raises:
        SetupError: none is shipped.
    """
    found = shipped(setting)
    if found is None:
        raise SetupError(f"{setting.object}: no bundle of it is shipped for this skin")
    return found


@lru_cache(maxsize=8)
def model_of(setting: Setting) -> ObservationModel:
    """The same instance each time: models are compared by identity."""
    found = shipped(setting)
    return setting.model() if found is None else found.model


def is_learned(name: str, setting: Setting) -> bool:
    """Whether a proposal comes from a file that an experiment trains: none ships it."""
    return name in LEARNED and not (name == DENSITY and shipped(setting) is not None)


def proposal_of(name: str, setting: Setting, file: str) -> Proposal:
    """By name; a learned one that is not shipped is taken from `file`."""
    model = model_of(setting)
    if name in ANALYTIC:
        return ANALYTIC[name](model)
    if is_learned(name, setting):
        return Sampler.read(Path(file), model.layout, LEARNED[name].kind)
    return shipped_with(setting).proposal(name)
