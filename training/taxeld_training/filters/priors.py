"""`taxeld-train evaluate prior`: what a told pose is worth, what a wrong one costs, and what is
left of a belief after a restart, whether the object was moved meanwhile or not.

All cases have the touches of the same seeds. The table proposes.
"""

from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld.estimator.estimator import Estimator
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.model.symmetry import add_m
from taxeld.told import ToldPose, told_pose
from taxeld_hil import integrity
from taxeld_training.filters.cells import COLUMNS, setting_of
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.follow import OWN_SEEDS
from taxeld_training.filters.several import TABLED, known_of
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs import blocks
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects.setting import Setting

SEEDS, QUICK_SEEDS = 100, 1
TOUCHES, RESTARTED_AFTER = 10, 5
BLOCK = 10  # seeds a job
OBJECTS = "003_cracker_box", "025_mug"
SD = np.array([0.02, 0.02, 0.1])  # m, m, rad: of a told pose, as it claims
WRONG_M = 0.2  # how far a wrong one is off
CASES = ("none", "right", "right without yaw", "wrong", "restart", "restart, moved", "moved")


class PriorTouch(NamedTuple):
    """The estimate after a touch."""

    error_mm: float  # symmetric ADD
    p: float
    radius_mm: float


@dataclass(frozen=True)
class PriorCase:
    """Trials of an object in one of `CASES`."""

    setting: Setting
    case: str

    @property
    def name(self) -> str:
        return f"{self.setting.name} {self.case}"


def prior_rows(options: Options) -> list[Path]:
    """Rows of `evaluate prior`: each object in each case.

    Raises:
        SetupError: no such object.
    """
    count = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    wanted = {
        PriorCase(setting_of(name, COLUMNS, options), case): count
        for name in options.objects or OBJECTS
        for case in CASES
    }
    rows = [
        {"object": of.setting.object, "case": of.case} | _figures([*trials.values()])
        for of, trials in blocks.trials(wanted, play, options, BLOCK).items()
    ]
    return [write(options, "prior", rows)]


def play(told: PriorCase, first: int, count: int) -> list[list[PriorTouch]]:
    """Results of the trials of `count` seeds, of each touch."""
    known = known_of(told.setting)
    return [
        _played(told.case, known.model, known.proposal, seed)
        for seed in range(first, first + count)
    ]


def _played(case: str, model: ObservationModel, table: Proposal, seed: int) -> list[PriorTouch]:
    kidnapped = RESTARTED_AFTER if case.endswith("moved") else 0
    trial = Trial(model, seed, TOUCHES, TrialConditions(kidnapped_after=kidnapped))
    config = TABLED.config(OWN_SEEDS + seed)
    estimator, found = Estimator(model, table, config), []
    for touch, moments in groupby(trial, lambda moment: moment.touch):
        scans = list(moments)
        if touch == 0 and (pose := _pose(case, model, scans[0].truth, seed)):
            estimator.tell(pose)
        if touch == RESTARTED_AFTER and case.startswith("restart"):
            kept = estimator.history.kept()
            estimator = Estimator(model, table, config)
            estimator.restore(kept)
        for moment in scans:
            estimator.on_scan(moment.activation, moment.sensor)
        estimate = estimator.estimate
        error_mm = 1e3 * add_m(model.scene, estimate.map, scans[-1].truth)[1]
        found.append(PriorTouch(round(error_mm, 4), estimate.p, 1e3 * estimate.radius_m))
    return found


def _pose(case: str, model: ObservationModel, truth: Poses, seed: int) -> ToldPose | None:
    """What is told of an object at a true pose (3,)."""
    if case not in ("right", "right without yaw", "wrong"):
        return None
    rng = np.random.default_rng((seed, 7))
    at = truth + SD * rng.standard_normal(3)
    if case == "wrong":
        side = rng.uniform(-np.pi, np.pi)
        at[:2] += WRONG_M * np.array([np.cos(side), np.sin(side)])
    given: dict[str, Any] = {"x": float(at[0]), "y": float(at[1]), "cov": SD.tolist()}
    if case == "right without yaw":  # of the object's middle
        middle = model.scene.centre + SD[:2] * rng.standard_normal(2)
        at = se2.compose(truth, np.append(middle, 0.0))
        given["x"], given["y"] = at[:2].tolist()
    else:
        given["theta"] = float(se2.wrap(at[2]))
    pose = told_pose(given)
    if isinstance(pose, str):
        raise SetupError(pose)
    return pose


def _figures(trials: list[list[list[float]]]) -> dict[str, Any]:
    """Shares after each touch, and the touches until an estimate was sure."""
    error_mm, p, radius_mm = np.moveaxis(np.array(trials), -1, 0)
    found, sure = integrity.is_found(error_mm), integrity.is_sure(p)
    misleading = integrity.is_misleading(p, error_mm, radius_mm)
    first = np.where(sure.any(axis=1), sure.argmax(axis=1) + 1, TOUCHES + 1)
    late = slice(RESTARTED_AFTER, None)
    return {
        "trials": len(trials),
        "found": found.mean(axis=0).round(3).tolist(),
        "sure": sure.mean(axis=0).round(3).tolist(),
        "touches_to_sure": round(float(first.mean()), 2),
        "touches_to_sure_median": float(np.median(first)),
        "sure_estimates": int(sure.sum()),
        "misleading": int(misleading.sum()),
        "sure_after_restart": int(sure[:, late].sum()),
        "misleading_after_restart": int(misleading[:, late].sum()),
    }
