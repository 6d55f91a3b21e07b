"""Trials behind the interface of the harness's own, by the older world, until that has landed."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.config.tables import SensorPoseConfig, SkinConfig
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layout_files
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import ANALYTIC
from taxeld.proposals.sampler import Sampler
from taxeld_training.filters import follow, pushing
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.guides import Guide
from taxeld_training.filters.identities import UNKNOWN
from taxeld_training.filters.methods import SHIPPED, TABLED, Method
from taxeld_training.filters.pushing import PushedTrial
from taxeld_training.filters.trials import Trial, TrialScan
from taxeld_training.objects import DEPTH_MAX_M
from taxeld_training.objects.setting import Setting


@dataclass(frozen=True)
class Conditions:
    foam: str = "scene"
    keys: tuple[tuple[str, Any], ...] = ()
    dead_share: float = 0.0
    dead_modules: int = 0
    stuck: int = 0
    stuck_at: float = 1.0
    drift: float = 0.0
    press: tuple[float, float] = (0.0, 1.0)
    hold_s: float = 0.3
    slip_m: float = 0.0
    one_side: bool = False
    robot_m: float = SensorPoseConfig().sigma_m
    robot_rad: float = 0.0
    kidnapped_after: int = 0
    moved_m: float = 0.0
    moved_rad: float = 0.0
    nudged_m: float = 0.0
    both: int = 0

    def older(self) -> TrialConditions:
        return TrialConditions(
            skin="" if self.foam == "scene" else self.foam,
            dead_share=self.dead_share,
            dead_modules=self.dead_modules,
            stuck=self.stuck,
            stuck_at=self.stuck_at,
            drift=self.drift,
            depth=self.press[1],
            sensor_sd_m=self.robot_m if self.robot_m > 0.001 else 0.0,
            sensor_sd_rad=self.robot_rad,
            kidnapped_after=self.kidnapped_after,
            pushed_m=self.moved_m,
            pushed_rad=self.moved_rad,
            nudged_m=self.nudged_m,
            both=self.both,
            one_side=self.one_side,
            slip_m=self.slip_m,
            sigma=dict(self.keys).get("noise_counts", (34.0, 34.0))[0] / 1700.0,
            gain_cv=dict(self.keys).get("gain_cv", 0.17),
        )


@dataclass(frozen=True)
class Subject:
    name: str
    scale: float = 1.0
    height_m: float | None = None
    depth_m: float | None = None
    sampler: str = ""


@dataclass(frozen=True)
class Case:
    known: tuple[Subject, ...]
    touched: Subject | None = None
    layouts: tuple[str, ...] = ()
    conditions: Conditions = field(default_factory=Conditions)
    guide: str = "random"
    method: Method = TABLED
    motion: str = "none"
    touches: int = 8


class Touch(NamedTuple):
    object: int
    error_mm: float
    p: float
    radius_mm: float
    objects: tuple[float, ...]
    other: float
    moved: float
    status: str
    particles: int
    ms: float
    idle_ms: float
    guide_ms: float = 0.0
    path_mm: float = math.nan


@lru_cache(maxsize=64)
def model_of(subject: Subject, *skins: str) -> ObservationModel:
    depth_m = subject.depth_m or DEPTH_MAX_M
    return Setting(subject.name, skins[0], 0, scale=subject.scale, depth_max_m=depth_m).model()


def _skin(case: Case) -> str:
    return case.layouts[0] if case.layouts else SkinConfig().layout


@lru_cache(maxsize=64)
def _known(subject: Subject, skin: str, proposal: str) -> Known:
    model = model_of(replace(subject, sampler=""), skin)
    if proposal in ANALYTIC:
        return Known(model, ANALYTIC[proposal](model))
    path = Path(subject.sampler)
    kind = "density" if proposal == "density" else "ddpm"
    return Known(model, Sampler(path.read_bytes(), layout_files.load(skin), kind, path))


def moments(case: Case, seed: int) -> Iterator[TrialScan]:
    touched = case.touched or replace(case.known[0], sampler="")
    model = model_of(touched, _skin(case))
    return iter(Trial(model, seed, case.touches, case.conditions.older()))


def play(case: Case, seed: int) -> list[Touch]:
    subject = case.touched or case.known[0]
    known = [_known(each, _skin(case), case.method.proposal) for each in case.known]
    names = [each.name for each in case.known]
    model = model_of(replace(subject, sampler=""), _skin(case))
    if case.guide == "push":
        return [_pushed(PushedTrial(model, seed), case.motion, known[0].proposal)]
    true = names.index(subject.name) if subject.name in names else UNKNOWN
    estimator = follow.estimator_of(known, case.method, seed)
    older = {"random": "any", "straight": "random", "advised": "advice"}
    guide = Guide(older[case.guide], estimator, seed) if case.guide != "random" else None
    trial = Trial(model, seed, case.touches, case.conditions.older())
    run = follow.follow(replace(trial, guide=guide), estimator, true)
    costs_ms = [0.0, *guide.costs_ms] if guide and guide.costs_ms else [0.0] * len(run)
    return [
        Touch(
            touch.object,
            touch.map_mm,
            touch.p,
            touch.radius_mm,
            tuple(touch.objects),
            touch.hypotheses.other,
            touch.hypotheses.moved,
            touch.status.name.lower() if touch.status else "",
            touch.particles,
            touch.cpu_ms,
            touch.idle_ms,
            spent,
        )
        for touch, spent in zip(run, costs_ms, strict=True)
    ]


def _pushed(trial: PushedTrial, motion: str, proposal: Proposal) -> Touch:
    config = SHIPPED.config(follow.OWN_SEEDS + trial.seed, motion)
    estimator, errors = Estimator(trial.model, proposal, config), []
    for moment in trial:
        estimate = estimator.on_scan(moment.activation, moment.sensor)
        if moment.touch == pushing.TOUCHES and moment.activation.z.any():
            errors.append(follow.error_mm(trial.model, moment, estimate.map))
    path_mm, radius_mm = float(np.median(errors)), 1e3 * estimate.radius_m
    row = Touch(0, errors[-1], estimate.p, radius_mm, (1.0,), 0.0, 0.0, "", 0, math.nan, math.nan)
    return row._replace(path_mm=path_mm)
