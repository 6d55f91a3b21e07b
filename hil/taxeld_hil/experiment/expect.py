"""`taxeld-hil expect`: how well an object will be found with a skin, touch by touch; and what would
help: twice the patch, twice the foam's depth, or a calibration.

Its trials are those of `taxeld_sim.trials`: the daemon's default filter with the table, which needs
no training, on random presses. An object is *found*, and an estimate *sure* or *misleading*, as in
`integrity`.
"""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.layout.read import COLUMNS
from taxeld_hil.scenario.scenario import Scenario
from taxeld_protocol.modules import MAX_MODULES
from taxeld_sim.answers import score, tables
from taxeld_sim.answers.played import Played
from taxeld_sim.answers.questions import Cell
from taxeld_sim.jobs import save
from taxeld_sim.objects import meshes
from taxeld_sim.trials.case import DEFAULT_LAYOUT, Case
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject, model_of, solid_of

AS_IS = "as it is"
DEEPER = 2.0  # times the depth
DEPTHS_M = (1e-4, 0.05)  # limits, as of skin.full_scale_depth_m
ROBOT_MAX_M = 0.05
BELOW_M = 0.005  # under the lowest taxel: a skin is wider than its taxels
HALF = 0.5  # share of trials that are sure, at which what would help is compared
QUICK, LEAST = 10, 8  # seeds of --quick, and of which something is said
TRIAL_S = 2.5  # of a core of 2 GHz, for eight touches on foam
SHOWN = 2, 4, 6, 8, 12, 16, 24, 32  # touches of the table, and the last one
CHANCE = 2.0  # standard errors that chance alone may make


class Help(NamedTuple):
    """What a change does to the trials of the same seeds."""

    name: str
    trials: int
    after: int  # touches
    found: tuple[float, float]  # without and with it
    found_and_sure: tuple[float, float]
    verdict: str  # by the trials that are found and sure, against chance


def cells(asked: Subject, layout: str, given: Conditions, touches: int, place: Path) -> list[Cell]:
    """The trials as it is, and with what would change them. Layouts that are made for these are
    kept in `place`.

    Raises:
        SetupError: there is no such object or layout, or one does not go with the other.
    """
    if not 0.0 <= given.robot_m <= ROBOT_MAX_M:
        most = 1e3 * ROBOT_MAX_M
        raise SetupError(f"--robot-mm: must be 0..{most:g}, not {1e3 * given.robot_m:g}")
    subject, spec = _placed(asked, layout)
    if not DEPTHS_M[0] <= subject.own_depth_m <= DEPTHS_M[1]:
        raise SetupError(f"--depth-mm: must be 0.1..50, not {1e3 * subject.own_depth_m:g}")
    skin = layouts.load(spec)
    own = Case((subject,), layouts=(spec,), conditions=given, touches=touches)
    made = {AS_IS: own, "calibration": replace(own, conditions=replace(given, calibrated=True))}
    if 2 * len(np.unique(skin.uid >> 4)) <= MAX_MODULES:
        larger = _doubled(skin, place)
        rise_m = skin.position_m[:, 2].min() - layouts.load(larger).position_m[:, 2].min()
        higher = replace(subject, height_m=subject.own_height_m + float(rise_m))
        made["larger patch"] = replace(own, known=(higher,), layouts=(larger,))
    if DEEPER * subject.own_depth_m <= DEPTHS_M[1]:
        deeper = replace(subject, depth_m=DEEPER * subject.own_depth_m)
        made["deeper foam"] = replace(own, known=(deeper,))
    for case in made.values():  # built here once, before several workers need it
        model_of(case.subject, *case.specs)
        if not given.is_exact:
            solid_of(case.subject, *case.specs)
    labels = {"object": subject.name, "knows": "one"}
    return [Cell({"cell": name, **labels}, case) for name, case in made.items()]


def helps(done: Sequence[Played]) -> list[Help]:
    """What each change does, by trials of the same seeds, most helpful first; those without it come
    first. Shares are those after the first touch after which half of the trials are sure without
    it, or the last."""
    own = done[0].claims
    sure = own.found_and_sure.mean(axis=0)
    after = int(np.argmax(sure >= HALF)) if sure.max() >= HALF else len(sure) - 1
    found = []
    for each in done[1:]:
        pair = own, each.claims
        was, became = ((of.found[:, after], of.found_and_sure[:, after]) for of in pair)
        gain = became[1].astype(float) - was[1]
        least = CHANCE * math.sqrt((gain.var() + 1.0 / len(gain)) / len(gain))
        verdict = "not shown to help"
        if len(gain) < LEAST:
            verdict = "too few seeds to tell"
        elif abs(gain.mean()) > least:
            verdict = "would help" if gain.mean() > 0.0 else "would hurt"
        shares = [(float(a.mean()), float(b.mean())) for a, b in zip(was, became, strict=True)]
        name = str(each.labels["cell"])
        found.append(Help(name, len(gain), after + 1, shares[0], shares[1], verdict))
    return sorted(found, key=lambda each: each.found_and_sure[0] - each.found_and_sure[1])


def written(own: Case, done: Sequence[Played], out: Path) -> Iterator[str]:
    """The lines that are printed, with a Markdown table and a line on each change, once
    `expect.json` is written into the directory `out`.

    Raises:
        SetupError: the directory cannot be written.
    """
    model, given, changes = model_of(own.subject, *own.specs), own.conditions, helps(done)
    asked = own.subject.name, own.specs[0], given.foam, given.robot_m, model.depth_max_m
    asked_by = dict(zip(("object", "layout", "foam", "robot_m", "depth_m"), asked, strict=True))
    rows = score.rows(done, [["cell"]])
    about = {"asked": asked_by, "helps": [each._asdict() for each in changes]}
    path = save(out / "expect.json", "rows", rows, about)
    yield (
        f"{own.subject.name} on {model.layout.name}, {len(model.layout)} taxels, foam {given.foam} "
        f"of {1e3 * model.depth_max_m:g} mm, robot {1e3 * given.robot_m:g} mm: "
        f"{len(done[0].trials)} trials"
    )
    yield ""
    shown = " ".join(str(n) for n in range(1, own.touches + 1) if n in SHOWN or n == own.touches)
    yield tables.text(rows, f"cell | mm {own.touches} | found_and_sure {shown} | misleading")
    yield ""
    for each in changes:
        found, sure = (
            f"{100 * a:.0f} -> {100 * b:.0f} %" for a, b in (each.found, each.found_and_sure)
        )
        yield (
            f"{each.verdict}: {each.name} {found} found, {sure} found and sure after {each.after} "
            f"({each.trials} seeds)"
        )
    yield str(path)


def _placed(asked: Subject, layout: str) -> tuple[Subject, str]:
    """The object at the height at which it is touched, and the layout. Where that is not its
    bundle's own, the skin does not reach below the object.

    Raises:
        SetupError: there is no such object or layout.
    """
    built = asked.manifest
    if built is None:
        try:
            meshes.find(asked.name)
        except SetupError as error:
            raise SetupError(
                f"--object: {error}; or a bundle: box, drill, mug, or a path"
            ) from None
    spec = layout or (DEFAULT_LAYOUT if built is None else Scenario(asked.name).skin_layout)
    skin = layouts.load(spec)
    if asked.height_m is not None or (built and built.layout.digest == skin.digest):
        return asked, spec
    least_m = float(np.ceil(1e3 * (BELOW_M - skin.position_m[:, 2].min()))) / 1e3
    return replace(asked, height_m=max(asked.own_height_m, least_m)), spec


def _doubled(layout: Layout, place: Path) -> str:
    """The path of a table of a patch of two such layouts, one above the other."""
    position, (modules, module) = layout.position_m, np.unique(layout.uid >> 4, return_inverse=True)
    gap = np.linalg.norm(position[:, None] - position, axis=2) + 1e3 * np.eye(len(layout))
    step_m = float(np.ptp(position[:, 2]) + np.median(gap.min(axis=1)))
    lines = [",".join([*COLUMNS, "uid"])]
    for k in range(2):
        uid = (module + 1 + k * len(modules)) << 4 | layout.uid & 0xF
        rows = np.hstack([position + np.array([0.0, 0.0, k * step_m]), layout.normal])
        for row, own in zip(rows, uid, strict=True):
            lines.append(",".join([*(f"{v:.7f}" for v in row), str(own)]))
    text = "\n".join([*lines, ""])
    place.mkdir(parents=True, exist_ok=True)
    stem = Path(layout.name.split(":")[0]).stem
    path = place / f"{stem}-2-{hashlib.sha256(text.encode()).hexdigest()[:12]}.csv"
    path.write_text(text, encoding="ascii")
    return str(path)
