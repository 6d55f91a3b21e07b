"""`taxeld-hil calibration`: what a calibration finds and gains, and what is noticed without one.

Runs of a skin and a seed. `find` calibrates by a box, with a random mount, and the object's pose
once given and once not. `buy` calibrates likewise and touches the box elsewhere, with the
calibration and without it. All others count touches until a fault of the calibration is noticed.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld_hil.calibration.calibrate import Result
from taxeld_hil.experiment import calibration_runs as runs
from taxeld_hil.experiment.measurement import digest
from taxeld_hil.jobs import Job, run
from taxeld_hil.scenario import scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.world import load_model

MOUNT_MOST = np.array([0.003, 0.003, np.radians(3.0)])  # of the mounts that are drawn
TOUCHES, SOON = 12, 8  # until a doubt must have been raised; an early doubt
FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "full scale ×2.5": {"factor": 2.5},
    "full scale ÷2.5": {"factor": 0.4},
    "mount 3 mm": {"mount": np.array([0.003, 0.0, 0.0])},
    "mount 3°": {"mount": np.array([0.0, 0.0, np.radians(3.0)])},
    "modules swapped": {"modules": (2, 3)},
}
QUICK_SEEDS = 1


class Case(NamedTuple):
    """One run: of which kind, with which object, skin and seed."""

    sort: str  # find, buy or one of FAULTS
    object: str
    skin: str
    seed: int


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    skins: tuple[str, ...] = ("typical", "poor")
    seeds: int = 10  # of `find` and `buy`, and of each fault
    right_seeds: int = 15  # with nothing wrong, on each skin

    def cases(self) -> list[Case]:
        return [
            Case(sort, name, skin, seed)
            for seed in range(max(self.seeds, self.right_seeds))
            for skin in self.skins
            for sort in ("find", "buy", *FAULTS)
            for name in (("box", "mug") if sort == "none" else ("box",))
            if seed < (self.right_seeds if sort == "none" else self.seeds)
        ]


def experiment(plan: Plan, out: Path, memory: Path, workers: int) -> Path:
    """Measure, and write `calibration.json` into the directory `out`; runs are remembered in the
    directory `memory`, so that a measurement that was cut short goes on.

    Raises:
        SetupError: there is no mesh here, or the memory cannot be written.
    """
    if plan.seeds < 1:
        raise SetupError("--seeds must be at least 1")
    base = scenario.load("demo")
    for skin in plan.skins:
        if base.on(skin).physics == "scene":
            raise SetupError("--skin scene: is no soft skin; name typical, poor or stiff")
    for name in ("box", "mug"):  # each mesh is built once, and not by every worker
        solid_of(name, load_model(replace(base, bundle=name)).layout)
    jobs = {case: _job(case) for case in plan.cases()}
    done = run(list(jobs.values()), memory, workers=workers, describe=str)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "calibration.json"
    rows = ({**case._asdict(), **done[job.name]} for case, job in jobs.items())
    each = ",\n  ".join(map(json.dumps, rows))
    text = f'{{"plan": {json.dumps(asdict(plan))},\n "runs": [\n  {each}\n ]\n}}\n'
    path.write_text(text, encoding="utf-8")
    return path


def play(case: Case, code: str) -> dict[str, Any]:
    """One run's row; `code` is part of the job's key alone."""
    del code
    at, seed = _at(case), case.seed
    if case.sort in FAULTS:
        touch, suspect = runs.noticed(at, seed, TOUCHES, **FAULTS[case.sort])
        return {"noticed_after": touch, "suspect": suspect}
    mount = _mount(seed)
    if case.sort == "find":
        return {kind: _found(at, seed, mount, given=kind == "given") for kind in ("given", "found")}
    result, _ = runs.calibrated(at, seed, mount)
    return {
        "without": runs.errors_mm(at, seed, np.zeros(3), None),
        "without, mount off": runs.errors_mm(at, seed, mount, None),
        "with": runs.errors_mm(at, seed, mount, result.calibration),
    }


def pictured(skin: str) -> Result:
    """A calibration to look at."""
    return runs.calibrated(_at(Case("find", "box", skin, 0)), 0, _mount(0))[0]


def lines(path: Path) -> Iterator[str]:
    """The runs of such a file in few numbers, as Markdown tables."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in json.loads(path.read_text(encoding="utf-8"))["runs"]:
        groups.setdefault((row["sort"], row["skin"], row["object"]), []).append(row)
    yield "| skin, pose | runs, refused | gains known | off: gains, median (most) | mount | yaw |"
    yield "|---|---|---|---|---|---|"
    for (sort, skin, _), group in groups.items():
        for kind in ("given", "found") if sort == "find" else ():
            yield f"| {skin}, {kind} | {_accuracy([row[kind] for row in group])} |"
    yield ""
    after = ", ".join(map(str, runs.AFTER))
    yield f"| skin | median error after {after} touches | without | with the mount off | with |"
    yield "|---|---|---|---|---|"
    for (sort, skin, _), group in groups.items():
        if sort == "buy":
            kinds = ("without", "without, mount off", "with")
            medians = [np.median([row[kind] for row in group], axis=0) for kind in kinds]
            cells = [", ".join(f"{mm:.2f}" for mm in each) + " mm" for each in medians]
            yield f"| {skin}, {len(group)} seeds | {' | '.join(cells)} |"
    yield ""
    yield f"| what is wrong | skin, object | runs | doubts | within {SOON} touches | about |"
    yield "|---|---|---|---|---|---|"
    for (sort, skin, name), group in groups.items():
        if sort in FAULTS:
            touch = np.array([row["noticed_after"] for row in group])
            found = [row["suspect"] for row in group if row["suspect"]]
            about = ", ".join(f"{found.count(each)} {each}" for each in sorted(set(found)))
            soon = np.count_nonzero((touch > 0) & (touch <= SOON))
            raised = np.count_nonzero(touch)
            yield f"| {sort} | {skin}, {name} | {len(group)} | {raised} | {soon} | {about} |"


def _accuracy(found: list[dict[str, Any]]) -> str:
    """The cells of a row of the first table."""
    good = [each for each in found if "refused" not in each]
    head = f"{len(found)}, {len(found) - len(good)}"
    if not good:
        return f"{head} | | | |"
    known, gain, mount, yaw = (
        (np.median(values), np.max(values))
        for values in (
            [each[key] for each in good if each[key] is not None]
            for key in ("gains_known", "gain_off", "mount_off_mm", "yaw_off_deg")
        )
    )
    return (
        f"{head} | {known[0]:.0f} | {gain[0]:.1%} ({gain[1]:.1%}) "
        f"| {mount[0]:.2f} ({mount[1]:.2f}) mm | {yaw[0]:.2f} ({yaw[1]:.2f})°"
    )


def _found(at: scenario.Scenario, seed: int, mount: Poses, *, given: bool) -> dict[str, Any]:
    """How far the calibration is off."""
    try:
        result, full_scale = runs.calibrated(at, seed, mount, given=given)
    except SetupError as error:
        return {"refused": str(error)}
    c, known = result.calibration, result.known
    off = np.abs(c.full_scale_counts * c.gain / full_scale - 1.0)
    mount_off = np.abs(c.mount - mount)
    return {
        "gains_known": int(known.sum()),
        "gain_off": round(float(np.median(off[known])), 4) if known.any() else None,
        "gains_within_2_sd": round(float(np.mean(off < 2.0 * c.gain_sd)), 4),
        "mount_off_mm": round(1e3 * float(np.hypot(*mount_off[:2])), 4),
        "yaw_off_deg": round(float(np.degrees(mount_off[2])), 4),
        "left": round(result.fit.left, 4),
    }


def _mount(seed: int) -> Poses:
    """(3,)"""
    return np.random.default_rng([seed, 3]).uniform(-MOUNT_MOST, MOUNT_MOST)


def _job(case: Case) -> Job:
    name = f"{case.sort}, {case.object}, {case.skin}, seed {case.seed}"
    return Job(name, play, (case, digest(_at(case))))


def _at(case: Case) -> scenario.Scenario:
    return scenario.load("demo").touching(case.object).on(case.skin)
