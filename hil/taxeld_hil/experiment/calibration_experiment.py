"""`taxeld-hil calibration`: what a calibration finds and buys, and what is noticed without one.

Three sorts of runs, each of a skin and a seed. `find` calibrates by a box, the mount drawn within
3 mm and 3°, and the object's pose once given and once not. `buy` calibrates likewise and touches
the box elsewhere, with the calibration and without it. `notice` counts touches until a doubt is
raised: of nothing, a wrong full scale, a wrong mount, and modules that have changed places.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.commands.calibration_result import Result
from taxeld.errors import SetupError
from taxeld_hil.experiment import calibration_runs as runs
from taxeld_hil.experiment.calibration_tables import rounded, summary
from taxeld_hil.experiment.jobs import Memory, digest, played
from taxeld_hil.scenario import scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.world import load_model

MOUNT_MOST = np.array([0.003, 0.003, np.radians(3.0)])  # of the mounts that are drawn
TOUCHES = 12  # until a doubt must have been raised
FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "full scale ×2.5": {"factor": 2.5},
    "full scale ÷2.5": {"factor": 0.4},
    "mount 3 mm": {"mount": np.array([0.003, 0.0, 0.0])},
    "mount 3°": {"mount": np.array([0.0, 0.0, np.radians(3.0)])},
    "modules swapped": {"modules": (2, 3)},
}
QUICK_SEEDS = 1

Say = Callable[[str], None]


class Job(NamedTuple):
    """One run."""

    sort: str  # find, buy or one of FAULTS
    object: str
    skin: str
    seed: int


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    skins: tuple[str, ...] = ("typical", "poor")
    seeds: int = 10  # of `find` and `buy`, and of each fault
    right_seeds: int = 15  # of `notice` with nothing wrong, on each skin

    def jobs(self) -> list[Job]:
        return [
            Job(sort, name, skin, seed)
            for seed in range(max(self.seeds, self.right_seeds))
            for skin in self.skins
            for sort in ("find", "buy", *FAULTS)
            for name in (("box", "mug") if sort == "none" else ("box",))
            if seed < (self.right_seeds if sort == "none" else self.seeds)
        ]


def experiment(plan: Plan, out: Path, memory: Path, workers: int, say: Say) -> Path:
    """Measure, and write `calibration.json` into the directory `out`; runs are remembered in
    `memory`, so that a measurement that was cut short goes on.

    Raises:
        SetupError: there is no mesh here, or the memory cannot be written.
    """
    if plan.seeds < 1 or workers < 1:
        raise SetupError("--seeds and --workers must be at least 1")
    base = scenario.load("demo")
    for skin in plan.skins:
        if base.on(skin).physics == "scene":
            raise SetupError("--skin scene: is no soft skin; name typical, poor or stiff")
    for name in ("box", "mug"):  # each mesh is built once, and not by every worker
        solid_of(name, load_model(replace(base, bundle=name)).layout)
    jobs = plan.jobs()
    codes = {job: digest(_at(job)) for job in jobs}
    with Memory(memory) as remembered:
        done = {Job(*each["job"]): each["row"] for each in remembered.rows(set(codes.values()))}
        todo = [job for job in jobs if job not in done]
        if len(todo) < len(jobs):
            say(f"{len(jobs) - len(todo)} of {len(jobs)} runs are remembered in {memory}")
        for job, row in played(_played, todo, workers):
            done[job] = row
            remembered.add(codes[job], {"job": job, "row": row})
            say(f"{job.sort}, {job.object}, {job.skin}, seed {job.seed}: {row}")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "calibration.json"
    rows = [{**job._asdict(), **done[job]} for job in jobs]
    head = {"plan": asdict(plan), "summary": summary(rows)}
    text = json.dumps(head, indent=1).removesuffix("\n}")
    each = ",\n  ".join(json.dumps(row) for row in rows)
    path.write_text(f'{text},\n "runs": [\n  {each}\n ]\n}}\n', encoding="utf-8")
    return path


def play(job: Job) -> dict[str, Any]:
    """One run's row."""
    at = _at(job)
    if job.sort in FAULTS:
        touch, suspect = runs.noticed(at, job.seed, TOUCHES, **FAULTS[job.sort])
        return {"noticed_after": touch, "suspect": suspect}
    mount = np.random.default_rng([job.seed, 3]).uniform(-MOUNT_MOST, MOUNT_MOST)
    if job.sort == "find":
        return {
            "given": _found(at, job.seed, mount, given=True),
            "found": _found(at, job.seed, mount, given=False),
        }
    result, _ = runs.calibrated(at, job.seed, mount)
    still = np.zeros(3)
    return {
        "without": runs.errors_mm(at, job.seed, still, None),
        "without, mount off": runs.errors_mm(at, job.seed, mount, None),
        "with": runs.errors_mm(at, job.seed, mount, result.calibration),
    }


def pictured(skin: str) -> Result:
    """A calibration to look at."""
    at = replace(scenario.load("demo"), bundle="box", physics=skin)
    mount = np.random.default_rng([0, 3]).uniform(-MOUNT_MOST, MOUNT_MOST)
    return runs.calibrated(at, 0, mount)[0]


def _found(at: scenario.Scenario, seed: int, mount: Poses, *, given: bool) -> dict[str, Any]:
    """How far the calibration is off, and how far it says it may be."""
    try:
        result, full_scale = runs.calibrated(at, seed, mount, given=given)
    except SetupError as error:
        return {"refused": str(error)}
    c, known = result.calibration, result.known
    off = c.full_scale_counts * c.gain / full_scale - 1.0
    mount_off = np.abs(c.mount - mount)
    return {
        "gains_known": int(known.sum()),
        "gain_off": rounded(np.median(np.abs(off[known]))) if known.any() else None,
        "gain_off_p90": rounded(np.quantile(np.abs(off[known]), 0.9)) if known.any() else None,
        "gains_within_2_sd": rounded(np.mean(np.abs(off) < 2.0 * c.gain_sd)),
        "mount_off_mm": rounded(1e3 * np.hypot(*mount_off[:2])),
        "yaw_off_deg": rounded(np.degrees(mount_off[2])),
        "noise_sigma": c.noise_sigma,
        "gain_cv": c.gain_cv,
        "left": rounded(result.fit.chi),
    }


def _played(job: Job) -> tuple[Job, dict[str, Any]]:
    return job, play(job)


def _at(job: Job) -> scenario.Scenario:
    return scenario.load("demo").touching(job.object).on(job.skin)
