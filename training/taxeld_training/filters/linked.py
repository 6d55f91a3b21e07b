"""`taxeld-train evaluate links`: an object touched by one of two links, and by both in turn.

All filters have the touches of the same seeds, so that they are paired: the object stands where it
stands, and each link has a sequence of touches of its own. The table proposes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import add_m
from taxeld.proposals.analytic import Table
from taxeld_hil.integrity import Claims
from taxeld_hil.objects import HEIGHT_M, meshes, scenes
from taxeld_training.filters.cells import TOUCHES
from taxeld_training.filters.follow import OWN_SEEDS
from taxeld_training.filters.several import TABLED
from taxeld_training.filters.touches import FOAMS
from taxeld_training.filters.trials import Trial, TrialScan
from taxeld_training.jobs import blocks
from taxeld_training.jobs.options import Options, write
from taxeld_training.objects import DEPTH_MAX_M
from taxeld_training.objects.setting import ring

SEEDS, QUICK_SEEDS = 40, 1
BLOCK = 5  # seeds a job
BETWEEN_S = 1.0  # time between two touches
OTHER_SEEDS = 2**20  # added to a trial's seed for each further link's touches
OBJECT = "003_cracker_box"
SKINS = ("exact", "typical")  # of `FOAMS`
TURNS = {"first": (0,), "second": (1,), "both": (0, 1)}  # the links that touch, in turn


class LinkedTouch(NamedTuple):
    """The estimate after a touch, as `Claims` has it, and what it cost."""

    p: float
    radius_mm: float
    error_mm: float  # symmetric ADD
    cpu_ms: float  # processor time of the filter for all scans of the touch


@dataclass(frozen=True)
class Linked:
    """Trials of an object on two links."""

    object: str
    layouts: tuple[str, str]
    skin: str  # of `SKINS`
    links: str  # of `TURNS`

    @property
    def name(self) -> str:
        return f"{self.object} {self.skin} {self.links}"


def link_rows(options: Options) -> list[Path]:
    """Rows of `evaluate links`: for each skin, and for each link alone and for both.

    Raises:
        SetupError: no such object or layout, or a skin misses it.
    """
    given = tuple(filter(None, options.layouts)) or (ring(16), ring(12, 0.03))
    if len(given) != 2:
        raise SetupError(f"--layout: links takes two, not {len(given)}")
    one, two = given
    count = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    name = (options.objects or (OBJECT,))[0]
    model_of(name, (one, two))
    wanted = {Linked(name, (one, two), skin, links): count for skin in SKINS for links in TURNS}
    rows = [
        {"object": name, "skin": of.skin, "links": of.links} | _figures([*trials.values()])
        for of, trials in blocks.trials(wanted, play, options, BLOCK).items()
    ]
    return [write(options, "links", rows)]


def model_of(name: str, on: tuple[str, str]) -> ObservationModel:
    """The object on the first link, with its model on the second."""
    mesh, skins = meshes.load(meshes.find(name)[0]), [layouts.load(each) for each in on]
    cut = scenes.build_all(mesh, [(skin, HEIGHT_M) for skin in skins])
    second = ObservationModel(cut[1], skins[1], DEPTH_MAX_M)
    return ObservationModel(cut[0], skins[0], DEPTH_MAX_M, [second])


def play(given: Linked, first: int, count: int) -> list[list[LinkedTouch]]:
    """Results of the trials of `count` seeds, of each touch."""
    model = model_of(given.object, given.layouts)
    tables = [Table(each) for each in model.links]
    return [_played(given, model, tables, seed) for seed in range(first, first + count)]


def _played(
    given: Linked, model: ObservationModel, tables: Sequence[Table], seed: int
) -> list[LinkedTouch]:
    config = TABLED.config(OWN_SEEDS + seed)
    estimator = Estimator(model, tables[0], config, beside=tables[1:])
    found = []
    for link, touch in _touches(given, model, seed):
        begun = process_time()
        for moment in touch:
            estimator.on_scan(moment.activation, moment.sensor, link)
        cpu_ms = 1e3 * (process_time() - begun)
        now = estimator.estimate
        error_mm = 1e3 * add_m(model.scene, now.map, touch[-1].truth)[1]
        found.append(LinkedTouch(now.p, 1e3 * now.radius_m, round(error_mm, 4), cpu_ms))
    return found


def _touches(
    given: Linked, model: ObservationModel, seed: int
) -> Iterator[tuple[int, list[TrialScan]]]:
    """The touches with their links, one after the other in time."""
    each = [
        [list(moments) for _, moments in groupby(trial, lambda moment: moment.touch)]
        for trial in (
            Trial(one, seed + k * OTHER_SEEDS, TOUCHES, FOAMS[given.skin])
            for k, one in enumerate(model.links)
        )
    ]
    start = each[0][0][0].truth
    turns, t = TURNS[given.links], 0.0
    for k in range(TOUCHES):
        link = turns[k % len(turns)]
        touch = each[link][k // len(turns)]
        # the object stands where it stands in the first link's trial
        move = se2.compose(start, se2.inverse(each[link][0][0].truth))
        after = t - touch[0].activation.t
        yield link, [_moved(moment, move, after) for moment in touch]
        t = after + touch[-1].activation.t + BETWEEN_S


def _moved(moment: TrialScan, move: Poses, after_s: float) -> TrialScan:
    activation = replace(moment.activation, t=moment.activation.t + after_s)
    sensor, truth = se2.compose(move, moment.sensor), se2.compose(move, moment.truth)
    return moment._replace(activation=activation, sensor=sensor, truth=truth)


def _figures(trials: list[list[list[float]]]) -> dict[str, Any]:
    """Shares after each touch, and how many touches a trial took until it stayed found."""
    *of, cpu_ms = np.moveaxis(np.array(trials), -1, 0)
    claims = Claims(*of)
    both = claims.found & claims.sure
    stays = np.logical_and.accumulate(both[:, ::-1], axis=1)
    taken = TOUCHES + 1 - stays.sum(axis=1)
    return {
        "trials": len(trials),
        "found": claims.found.mean(axis=0).round(3).tolist(),
        "found_and_sure": both.mean(axis=0).round(3).tolist(),
        "misleading": int(claims.misleading.sum()),
        "touches_to_sure": round(float(taken.mean()), 3),
        "touch_cpu_ms": round(float(np.median(cpu_ms[:, 1:])), 2),
    }
