"""`taxeld-train evaluate links`: an object touched by one of two links, and by both in turn.

All filters have the touches of the same seeds, so that they are paired: the object stands where it
stands, and each link has a sequence of touches of its own. The table proposes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from taxeld.errors import SetupError
from taxeld.estimator.bank import Known
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import Table
from taxeld_hil.objects import HEIGHT_M, meshes, scenes
from taxeld_training.filters import cells, follow
from taxeld_training.filters.cells import TOUCHES
from taxeld_training.filters.methods import TABLED, TouchResult, claims
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
        {"object": name, "skin": of.skin, "links": of.links}
        | claims([cells.read(*touch) for touch in run] for run in trials.values()).by_touch()
        for of, trials in blocks.trials(wanted, play, options, BLOCK).items()
    ]
    return [write(options, "links", rows)]


def model_of(name: str, on: tuple[str, str]) -> ObservationModel:
    """The object on the first link, with its model on the second."""
    mesh, skins = meshes.load(meshes.find(name)[0]), [layouts.load(each) for each in on]
    cut = scenes.build_all(mesh, [(skin, HEIGHT_M) for skin in skins])
    second = ObservationModel(cut[1], skins[1], DEPTH_MAX_M)
    return ObservationModel(cut[0], skins[0], DEPTH_MAX_M, [second])


def play(given: Linked, first: int, count: int) -> list[list[TouchResult]]:
    """Results of the trials of `count` seeds, of each touch."""
    model = model_of(given.object, given.layouts)
    table, *beside = (Table(each) for each in model.links)
    known = [Known(model, table, beside)]
    return [
        follow.follow(_touches(given, model, seed), follow.estimator_of(known, TABLED, seed))
        for seed in range(first, first + count)
    ]


def _touches(given: Linked, model: ObservationModel, seed: int) -> Iterator[TrialScan]:
    """The touches of the links, one after the other in time."""
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
        after_s = t - touch[0].activation.t
        for moment in touch:
            t = moment.activation.t + after_s
            yield moment._replace(
                touch=k,
                activation=replace(moment.activation, t=t),
                sensor=se2.compose(move, moment.sensor),
                truth=se2.compose(move, moment.truth),
                link=link,
            )
        t += BETWEEN_S
