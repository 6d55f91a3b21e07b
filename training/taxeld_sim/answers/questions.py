"""The questions of `questions.toml`, and the trials that answer one of them."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from taxeld.errors import SetupError
from taxeld_sim.jobs import layout_name
from taxeld_sim.objects import meshes
from taxeld_sim.trials.case import TABLED, Case, Method
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject

Labels: TypeAlias = Mapping[str, str | tuple[str, ...]]  # by kind; of several values each counts

FOAMS = "exact", "typical", "poor"  # cells
ALL, TUNED, NEW, SOFT, WRONG = "all", "tuned", "not tuned", "soft skin", "another object"  # parts
LOOKED_AT = "two"  # objects on which the filter's constants were set
TRIAL_KEYS = {each.name for each in fields(Conditions)}
QUICK_SEEDS, QUICK_OBJECTS, QUICK_CELLS, QUICK_READINGS, QUICK_EFFORT = 2, 2, 2, 4, 0.02


@dataclass(frozen=True)
class Question:
    """An entry of the file, with its lists of objects."""

    name: str
    says: str
    objects: tuple[str, ...]
    cells: tuple[str, ...]
    by: tuple[tuple[str, ...], ...]  # kinds of labels; a row for each combination of their values
    tables: tuple[str, ...] = ()  # that are printed, as `tables.text` has them
    charts: tuple[str, ...] = ()  # of `charts`
    methods: tuple[str, ...] = ("table",)
    guides: tuple[str, ...] = ("random",)
    motions: tuple[str, ...] = ("none",)
    touches: int = 8
    seeds: int = 40
    effort: float = 0.5  # share of a sampler's full training
    knows: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # lists of known objects
    strangers: tuple[str, ...] = ()  # objects that the first of these lists meets as well
    readings: int = 0  # for each object and ring, on which samplers are measured
    columns: tuple[int, ...] = ()  # of these rings
    proposals: tuple[str, ...] = ()
    tilts: tuple[float, ...] = ()  # of recorded arms, at most [rad]: its trials are recordings


@dataclass(frozen=True)
class Cell:
    """Trials of a question that differ in their seed alone."""

    labels: Labels
    case: Case


@dataclass(frozen=True)
class Selection:
    """What is wanted of all questions; empty is the question's own."""

    quick: bool = False
    seeds: tuple[int, ...] = ()
    objects: tuple[str, ...] = ()
    only: tuple[str, ...] = ()  # names of cells, or their first words, methods, guides, motions
    layouts: tuple[str, ...] = ("",)  # "": the usual ring
    data: Path | None = None  # folder of recordings


@cache
def table() -> dict[str, Any]:
    text = resources.files(__package__).joinpath("questions.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def names(*, recorded: bool = True) -> list[str]:
    """The questions, those by recordings as well, or without them."""
    return [k for k, v in table().items() if "says" in v and (recorded or "tilts" not in v)]


def load(name: str, asked: Selection) -> Question:
    """The question `name`, within what is asked.

    Raises:
        SetupError: there is no such question or object.
    """
    if name not in names():
        raise SetupError(f"QUESTION: no '{name}'; there are {', '.join(names())}")
    given = dict(table()[name])
    most = QUICK_OBJECTS if asked.quick else None
    given["objects"] = asked.objects or listed(given["objects"])[:most]
    given["knows"] = {each: listed(each)[:most] for each in given.get("knows", ())}
    given["strangers"] = listed(given["strangers"])[:most] if "strangers" in given else ()
    if given["knows"] and asked.objects:
        given["knows"] = {"asked": asked.objects}
    if given["cells"] == ALL:
        given["cells"] = [*table()["cells"]]
    if asked.quick:
        given |= {"seeds": QUICK_SEEDS, "effort": QUICK_EFFORT}
        given["tilts"] = given.get("tilts", [])[:1]
        given["columns"] = given.get("columns", [])[:1]
        given["readings"] = QUICK_READINGS
        if not asked.only:
            given["cells"] = given["cells"][:QUICK_CELLS]
    for each in () if given.get("tilts") else (*given["objects"], *given["strangers"]):
        meshes.find(Subject(each).mesh)
    return Question(name, **{key: _frozen(value) for key, value in given.items()})


def listed(name: str) -> tuple[str, ...]:
    """The objects of a list."""
    return tuple(table()["objects"][name])


def cells(question: Question, asked: Selection) -> list[Cell]:
    """The trials of a question but for their seeds.

    Raises:
        SetupError: `only` names what there is not, or a layout has no cell.
    """
    kinds = {
        "cell": {name: dict(table()["cells"][name]) for name in question.cells},
        "method": {name: table()["methods"][name] for name in question.methods},
        "guide": {name: {} for name in question.guides},
        "motion": {name: {} for name in question.motions},
    }
    _choose(kinds, asked.only)
    kinds["cell"] = _with_layouts(kinds["cell"], asked.layouts)
    found = []
    for cell, method, guide, motion in product(*kinds.values()):
        keys = kinds["cell"][cell]
        if asked.objects and "objects" in keys:
            continue
        own = _method(kinds["method"][method], keys.get("particles", 0))
        skins = tuple(keys.get("layouts", ()))
        case = Case((), None, skins, _conditions(keys), guide, own, motion, question.touches)
        here = {"cell": cell, "method": method, "guide": guide, "motion": motion}
        for labels, known, touched in _subjects(question, keys):
            one = replace(case, known=known, touched=touched)
            found.append(Cell({**here, **labels, "part": parts(labels, keys)}, one))
    return found


def _method(given: Mapping[str, Any], particles: int) -> Method:
    """A filter of the table of methods, or of so many `particles`."""
    more = {"particles": particles, "particles_max": 0} if particles else {}
    return replace(TABLED, **{**given, **more})


def parts(labels: Labels, keys: Mapping[str, Any]) -> tuple[str, ...]:
    """The parts of all trials in which a cell's count: those on which the filter was tuned, or
    new ones. The rule is fixed: whoever tunes on new trials moves them to the tuned ones."""
    looked_at = labels["object"] in listed(LOOKED_AT) or "objects" in keys
    found = [ALL, TUNED if looked_at and not keys.get("new") else NEW]
    found += [SOFT] if keys.get("foam") and "touched" not in keys else []
    found += [WRONG] if "touched" in keys else []
    return tuple(found)


def _subjects(
    question: Question, keys: Mapping[str, Any]
) -> Iterator[tuple[dict[str, str], tuple[Subject, ...], Subject | None]]:
    """Labels, the objects that the filter knows, and the touched one."""

    def subject(name: str) -> Subject:
        return Subject(name, keys.get("scale", 1.0), depth_m=keys.get("depth_m"))

    def labels(knows: str, touched: str, name: str) -> dict[str, str]:
        own = Path(name).stem if "/" in name else name
        return {"knows": knows, "touched": touched, "object": own}

    for name in listed(keys["objects"]) if "objects" in keys else question.objects:
        if "touched" not in keys:
            yield labels("one", "known", name), (subject(name),), None
            continue
        for touched in listed(keys["touched"]):
            if touched != name:
                yield labels("one", touched, name), (subject(name),), subject(touched)
    for number, (knows, known) in enumerate(question.knows.items()):
        all_known = tuple(map(subject, known))
        for touched in known:
            yield labels(knows, "known", touched), all_known, subject(touched)
        for touched in () if number else question.strangers:
            yield labels(knows, "stranger", touched), all_known, subject(touched)


def _with_layouts(
    own: dict[str, dict[str, Any]], layouts: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Cells by name, those of a foam alone on other layouts as well; without "" only there."""
    found = own if "" in layouts else {}
    for layout in filter(None, layouts):
        for foam in FOAMS:
            if foam in own:
                keys = own[foam] | {"layouts": [layout], "new": True}
                found[f"{foam} on {layout_name(layout)}"] = keys
    if not found:
        raise SetupError(f"--layout: goes with the cells {', '.join(FOAMS)}; name one of them")
    return found


def _choose(kinds: Mapping[str, dict[str, Any]], only: Sequence[str]) -> None:
    """Keep what `only` names of each kind, or all of a kind of which it names nothing. A cell is
    also named by its first word."""
    wanted: dict[str, set[str]] = {}
    for name in only:
        named = [(kind, own) for kind, of in kinds.items() for own in of if own == name]
        named = named or [("cell", own) for own in kinds["cell"] if own.startswith(f"{name} ")]
        if not named:
            known = [own for of in kinds.values() for own in of]
            raise SetupError(f"--cells: no '{name}' here; there are {', '.join(known)}")
        for kind, own in named:
            wanted.setdefault(kind, set()).add(own)
    for kind, kept in wanted.items():
        for own in [own for own in kinds[kind] if own not in kept]:
            del kinds[kind][own]


def _conditions(keys: Mapping[str, Any]) -> Conditions:
    given = {key: _frozen(value) for key, value in keys.items() if key in TRIAL_KEYS}
    return Conditions(**given | {"keys": tuple(_frozen(dict(keys.get("keys", {}))).items())})


def _frozen(value: Any) -> Any:
    """TOML's value, as a frozen class may hold it."""
    if isinstance(value, dict):
        return {key: _frozen(each) for key, each in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
