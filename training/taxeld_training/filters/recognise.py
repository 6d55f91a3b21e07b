"""`taxeld-train evaluate recognise`: which of ten objects is felt, or that it is none of them.

A filter knows ten objects and meets each of them, on exact readings and on soft skin, and ten that
it does not know. A second filter knows those ten: nothing was set on them. The table proposes, as
nothing is trained for this. The filter that knows the touched object alone, on the same touches,
says what not knowing costs.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_hil.integrity import is_found, is_sure
from taxeld_hil.objects import meshes
from taxeld_training.filters import several
from taxeld_training.filters.cells import COLUMNS, TOUCHES, setting_of
from taxeld_training.filters.levels import UNMET
from taxeld_training.filters.several import Compared, Crowd, Recognised
from taxeld_training.filters.touches import FOAMS
from taxeld_training.jobs import blocks, identities
from taxeld_training.jobs.identities import UNKNOWN
from taxeld_training.jobs.identity_tables import tables
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.promises import rate
from taxeld_training.jobs.statistics import share
from taxeld_training.objects.setting import OBJECTS, Setting

SEEDS, QUICK_SEEDS = 100, 2  # about an hour on two cores
UNKNOWN_SEEDS = 0.5  # factor of the number of trials with an object that the filter does not know
QUICK_OBJECTS = 2
BLOCK = 10  # seeds a job
TEN, OTHER_TEN = "the ten", "ten others"  # names of the filters, by the objects that they know
SKINS = ("exact", "typical")  # of `FOAMS`
ALL = "all"
SHOWN = (2, 4, 6)  # contacts with a confusion matrix
TOLD = (4, 6, 8)  # contacts after which unknown objects are looked for

Runs = dict[Crowd, list[list[Compared]]]  # results of each touch of the trials


def recognise_rows(options: Options) -> list[Path]:
    """Rows, tables and picture of `evaluate recognise`.

    Raises:
        SetupError: no such object or layout, or the skin misses one.
    """
    from taxeld_training.charts import identity_chart  # noqa: PLC0415  # matplotlib is not needed to train

    each = filters_of(options)
    done = {
        crowd: [[_read(*touch) for touch in trial] for trial in trials.values()]
        for crowd, trials in blocks.trials(
            wanted(each, options), several.play, options, BLOCK
        ).items()
    }
    found = [
        row
        for (of, names), skin in ((one, skin) for one in each.items() for skin in SKINS)
        for row in _rows({"of": of, "skin": skin}, names, done)
    ]
    data = write(options, "recognise", found, tables(found))
    identity_chart.draw([row for row in found if row["of"] == TEN], data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def filters_of(options: Options) -> dict[str, tuple[str, ...]]:
    """The objects that each filter knows: `--objects`, or the paper's ten; and others."""
    most = QUICK_OBJECTS if options.quick else None
    first = options.objects or OBJECTS[:most]
    return {TEN: first, OTHER_TEN: tuple(name for name in UNMET if name not in first)[:most]}


def wanted(each: Mapping[str, tuple[str, ...]], options: Options) -> dict[Crowd, int]:
    """The trials: each filter with all objects that it knows, the first with the others as well."""
    seeds, settings = _seeds(options), {}
    for name in (name for names in each.values() for name in names):
        meshes.find(name)
        settings[name] = _setting(name, options)
    found = {}
    for of, names in each.items():
        known = tuple(settings[name] for name in names)
        for name in names if of == OTHER_TEN else settings:
            count = seeds if name in names else max(round(UNKNOWN_SEEDS * seeds), 1)
            for skin in SKINS:
                found[Crowd(known, settings[name], FOAMS[skin])] = count
    return found


def _seeds(options: Options) -> int:
    return options.seeds or (QUICK_SEEDS if options.quick else SEEDS)


def _setting(name: str, options: Options) -> Setting:
    setting, layout = setting_of(name, COLUMNS, options), options.layouts[0]
    return replace(setting, skin=layout, columns=0) if layout else setting


def _rows(where: dict[str, str], names: Sequence[str], done: Runs) -> list[dict[str, Any]]:
    """Rows of a filter that knows the objects `names`, on one skin."""
    mine = {
        crowd: runs
        for crowd, runs in done.items()
        if crowd.conditions == FOAMS[where["skin"]]
        and tuple(setting.object for setting in crowd.known) == tuple(names)
    }
    every = [(crowd.true, run) for crowd, runs in mine.items() for run in runs]
    known = [(true, run) for true, run in every if true != UNKNOWN]
    if not known:
        return []
    given = several.identities([(true, [touch.several for touch in run]) for true, run in every])
    own = given.only(given.known)
    objects = {ALL: own} | {name: own.only(own.true == k) for k, name in enumerate(names)}
    found: list[dict[str, Any]] = [
        {"figure": "identity", **where, "object": name, "contact": contact}
        | identities.after(of, contact)
        | {"seeds": len(of)}
        for name, of in objects.items()
        if len(of)
        for contact in range(1, TOUCHES + 1)
    ]
    for each in found:
        number = names.index(each["object"]) if each["object"] != ALL else None
        same = [run for true, run in known if number in (None, true)]
        each.update(_alone(same, each["contact"]))
    found.append({"figure": "cost", **where, **_cost([run for _, run in known])})
    bins, error = identities.identity_bins(own)
    found.append(
        {"figure": "calibration", **where, "ece": error}
        | {"ece_with_unknown": identities.identity_bins(given)[1], "reliability": bins}
        | {"wrong_object_sure": rate((own.sure & ~own.right).ravel())}
        | {"far_and_sure": rate((own.sure & own.right & ~own.found).ravel())}
        | {"estimates": own.sure.size}
    )
    found += [
        {"figure": "parting", **where, **pair}
        for pair in identities.parting(own, names)
        if pair["q90"] is None
    ]
    found += [
        {"figure": "confusion", **where, "contact": contact, "names": list(names)}
        | {"shares": identities.confusion(given, contact)}
        for contact in SHOWN
    ]
    if len(own) < len(given):
        unknown = given.only(~given.known)
        sizes = {"seeds": len(own), "unknown_seeds": len(unknown)}
        found.append(
            {"figure": "unknown", **where, "sure": rate(unknown.sure.ravel()), **sizes}
            | {"sure_count": int(unknown.sure.sum()), "estimates": unknown.sure.size}
            | {"taken": _taken(mine, names)}
        )
        found += [
            {"figure": "unknown", **where, "contact": contact}
            | {"auroc": identities.told_apart(given, contact)}
            | share("sure_then", unknown.sure[:, contact - 1])
            for contact in TOLD
        ]
    return found


def _alone(runs: Sequence[Sequence[Compared]], contact: int) -> dict[str, Any]:
    """The share of runs that have found the object, by the filter that knows it alone."""
    one = [touch.one for touch in (run[contact - 1] for run in runs) if touch.one is not None]
    return share("found_alone", is_found([touch.map_mm for touch in one]))


def _taken(runs: Runs, names: Sequence[str]) -> dict[str, int]:
    """How many estimates are sure of an object while another one is touched, that is unknown."""
    found = Counter(
        f"{crowd.touched.object} for {names[touch.several.object]}"
        for crowd, each in runs.items()
        if crowd.true == UNKNOWN
        for run in each
        for touch in run
        if is_sure(touch.several.p)
    )
    return dict(found.most_common())


def _cost(runs: Sequence[Sequence[Compared]]) -> dict[str, float]:
    """What the touches (N, T) of known objects cost, and the longest call of `learn`."""
    pairs = [[(touch.several, touch.one or touch.several) for touch in run] for run in runs]
    cpu_ms = np.array([[[one.cpu_ms for one in pair] for pair in run] for run in pairs])
    worst_ms = np.array([[[one.worst_ms for one in pair] for pair in run] for run in pairs])
    found = identities.cost(cpu_ms[..., 0], cpu_ms[..., 1])
    for key, k in (("", 0), ("_one", 1)):
        each = worst_ms[..., k].max(axis=1)
        found[f"worst{key}_ms"] = round(float(each.max()), 2)
        found[f"worst{key}_median_ms"] = round(float(np.median(each)), 2)
    return found


def _read(known: Sequence[Any], one: Sequence[Any] | None) -> Compared:
    return Compared(Recognised(*known), None if one is None else Recognised(*one))
