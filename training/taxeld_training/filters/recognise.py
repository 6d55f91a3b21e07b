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

from taxeld_hil.integrity import is_found
from taxeld_hil.objects import meshes
from taxeld_training.filters import cells, identities
from taxeld_training.filters.cells import COLUMNS, TOUCHES, Cell, Results, setting_of
from taxeld_training.filters.identities import UNKNOWN, Identities
from taxeld_training.filters.levels import UNMET
from taxeld_training.filters.methods import TABLED, TouchResult
from taxeld_training.filters.touches import FOAMS
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.promises import rate
from taxeld_training.jobs.statistics import share
from taxeld_training.objects.setting import OBJECTS, Setting

SEEDS, QUICK_SEEDS = 100, 2  # about an hour on two cores
UNKNOWN_SEEDS = 0.5  # factor of the number of trials with an object that the filter does not know
QUICK_OBJECTS = 2
BLOCK = 10  # seeds a job
ALL = "all"
TEN, OTHER_TEN = "the ten", "ten others"  # names of the filters, by the objects that they know
SKINS = ("exact", "typical")  # of `FOAMS`
TOLD = (4, 6, 8)  # contacts after which unknown objects are looked for

Run = tuple[str, list[TouchResult]]  # the touched object, and the result of each touch


def recognise_rows(options: Options) -> list[Path]:
    """Rows and tables of `evaluate recognise`.

    Raises:
        SetupError: no such object or layout, or the skin misses one.
    """
    each = filters_of(options)
    done = cells.run(wanted(each, options).items(), options, BLOCK)
    found = [
        row
        for (of, names), skin in ((one, skin) for one in each.items() for skin in SKINS)
        for row in _rows({"of": of, "skin": skin}, names, done)
    ]
    return [write(options, "recognise", found)]


def filters_of(options: Options) -> dict[str, tuple[str, ...]]:
    """The objects that each filter knows: `--objects`, or the paper's ten; and others."""
    most = QUICK_OBJECTS if options.quick else None
    first = options.objects or OBJECTS[:most]
    return {TEN: first, OTHER_TEN: tuple(name for name in UNMET if name not in first)[:most]}


def wanted(each: Mapping[str, tuple[str, ...]], options: Options) -> dict[Cell, int]:
    """The trials: each filter with all objects that it knows, the first with the others as well;
    and the filters that know the touched object alone."""
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    every = [name for names in each.values() for name in names]
    for name in every:
        meshes.find(name)
    found = {}
    for of, names in each.items():
        first, *more = (_setting(name, options) for name in names)
        for touched in names if of == OTHER_TEN else every:
            count = seeds if touched in names else max(round(UNKNOWN_SEEDS * seeds), 1)
            for conditions in map(FOAMS.__getitem__, SKINS):
                found[Cell(first, TABLED, conditions, touched, tuple(more))] = count
                if touched in names:
                    found[Cell(_setting(touched, options), TABLED, conditions, touched)] = count
    return found


def _setting(name: str, options: Options) -> Setting:
    setting, layout = setting_of(name, COLUMNS, options), options.layouts[0]
    return replace(setting, skin=layout, columns=0) if layout else setting


def _rows(
    where: dict[str, str], names: Sequence[str], done: Mapping[Cell, Results]
) -> list[dict[str, Any]]:
    """Rows of a filter that knows the objects `names`, on one skin."""
    here = {cell: runs for cell, runs in done.items() if cell.conditions == FOAMS[where["skin"]]}
    alone = [
        (cell.touched, run)
        for cell, runs in here.items()
        if not cell.more and cell.touched in names
        for run in runs.values()
    ]
    every = [
        (cell.touched, run)
        for cell, runs in here.items()
        if tuple(setting.object for setting in cell.known) == tuple(names)
        for run in runs.values()
    ]
    if not any(name in names for name, _ in every):
        return []
    given = Identities.of([(number_of(names, name), run) for name, run in every])
    own, unknown = given.only(given.known), given.only(~given.known)
    found: list[dict[str, Any]] = [
        {"figure": "identity", **where, "object": name, "contact": contact}
        | identities.after(of, contact)
        | _alone([run for touched, run in alone if name in (ALL, touched)], contact)
        | {"seeds": len(of)}
        for name in (ALL, *names)
        for of in [own if name == ALL else own.only(own.true == names.index(name))]
        if len(of)
        for contact in range(1, TOUCHES + 1)
    ]
    several_ms, one_ms = (
        np.array([[touch.cpu_ms for touch in run] for name, run in runs if name in names])
        for runs in (every, alone)
    )
    found.append({"figure": "cost", **where, **identities.cost(several_ms, one_ms)})
    found.append(
        {"figure": "calibration", **where, "ece": identities.identity_error(own)}
        | {"ece_with_unknown": identities.identity_error(given)}
        | {"wrong_object_sure": rate((own.sure & ~own.right).ravel())}
        | {"far_and_sure": rate((own.sure & own.right & ~own.found).ravel())}
        | {"estimates": own.sure.size}
    )
    if len(unknown):
        sizes = {"seeds": len(own), "unknown_seeds": len(unknown)}
        found.append(
            {"figure": "unknown", **where, "sure": rate(unknown.sure.ravel()), **sizes}
            | {"sure_count": int(unknown.sure.sum()), "estimates": unknown.sure.size}
            | {"taken": _taken(every, names)}
        )
        found += [
            {"figure": "unknown", **where, "contact": contact}
            | {"auroc": identities.told_apart(given, contact)}
            | share("sure_then", unknown.sure[:, contact - 1])
            for contact in TOLD
        ]
    return found


def number_of(names: Sequence[str], name: str) -> int:
    return names.index(name) if name in names else UNKNOWN


def _alone(runs: Sequence[list[TouchResult]], contact: int) -> dict[str, Any]:
    """The share of runs that have found the object, by the filter that knows it alone."""
    return share("found_alone", is_found([run[contact - 1].map_mm for run in runs]))


def _taken(runs: Sequence[Run], names: Sequence[str]) -> dict[str, int]:
    """How many estimates are sure of an object while another one is touched, that is unknown."""
    found = Counter(
        f"{touched} for {names[touch.object]}"
        for touched, run in runs
        if touched not in names
        for touch in run
        if touch.sure
    )
    return dict(found.most_common())
