"""`taxeld-hil physics --touches`: ten touches on soft skins, seed by seed, as JSON."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from taxeld.errors import SetupError
from taxeld_hil.experiment import touch_runs
from taxeld_hil.experiment.jobs import Memory, digest, played
from taxeld_hil.experiment.overlooked import OVERLOOKED_NATS
from taxeld_hil.experiment.touch_runs import AFTER, FOUND_MM, PAIRS, PRESSES, TouchRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.world import load_model

CLOSE_MM = 5.0
QUICK_SEEDS = 2

Say = Callable[[str], None]
Job: TypeAlias = tuple[str, str, int]  # object, skin, seed


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    objects: tuple[str, ...] = ("box", "mug")  # bundles
    skins: tuple[str, ...] = ("typical", "poor")
    seeds: int = 30  # of each object and skin
    filter_keys: str = ""  # TOML for the daemon's [filter]


def experiment(plan: Plan, out: Path, memory: Path, workers: int, say: Say) -> Path:
    """Measure, and write `touches.json` into the directory `out`; runs are remembered in `memory`.

    Raises:
        SetupError: an object has no mesh here, there are faults in the plan, or the memory cannot
            be written.
    """
    if plan.seeds < 1 or workers < 1:
        raise SetupError("--seeds and --workers must be at least 1")
    base = scenario.load("demo")
    for skin in plan.skins:
        if base.on(skin).physics == "scene":
            raise SetupError("--skin scene: is no soft skin; name typical, poor or stiff")
    for name in plan.objects:  # each mesh is built once, and not by every worker
        solid_of(name, load_model(base.touching(name)).layout)
    wanted = [
        (name, skin, seed)
        for seed in range(plan.seeds)
        for skin in plan.skins
        for name in plan.objects
    ]
    codes = {each: digest(_scenario(each), plan.filter_keys) for each in wanted}
    with Memory(memory) as remembered:
        runs = [TouchRun(**row) for row in remembered.rows(set(codes.values()))]
        done = {(run.object, run.skin, run.seed): run for run in runs}
        todo = [each for each in wanted if each not in done]
        if len(todo) < len(wanted):
            say(f"{len(wanted) - len(todo)} of {len(wanted)} runs are remembered in {memory}")
        for run in played(partial(_play, plan.filter_keys), todo, workers):
            job = run.object, run.skin, run.seed
            done[job] = run
            remembered.add(codes[job], asdict(run))
            say(f"{run.object}, {run.skin}, seed {run.seed}: {run.error_mm} mm after {AFTER}")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "touches.json"
    write(path, plan, [done[each] for each in wanted])
    return path


def summary(runs: list[TouchRun]) -> list[dict[str, Any]]:
    """A row for each skin and object, in the order of the runs."""
    rows = []
    for skin, name in dict.fromkeys((run.skin, run.object) for run in runs):
        mine = [run for run in runs if (run.skin, run.object) == (skin, name)]
        error = np.array([run.error_mm for run in mine])
        scans, air, felt, light, missed = (
            sum(getattr(run, key) for run in mine)
            for key in ("scans", "air", "felt_in_air", "light", "missed")
        )
        rows.append({
            "skin": skin,
            "object": name,
            "seeds": len(mine),
            "error_mm": {
                f"after_{n}": {
                    "median": _quantile(error[:, k], 0.5),
                    "p90": _quantile(error[:, k], 0.9),
                    "under_5_mm": float(np.mean(error[:, k] < CLOSE_MM)),
                    "under_10_mm": float(np.mean(error[:, k] < FOUND_MM)),
                    "converged": float(np.mean([run.converged[k] for run in mine])),
                    "not_found": int(np.count_nonzero(error[:, k] >= FOUND_MM)),
                    "overlooked": sum((run.truth_nats[k] or 0.0) > OVERLOOKED_NATS for run in mine),
                }
                for k, n in enumerate(AFTER)
            },
            "felt_in_air_of_scans": felt / scans,
            "felt_in_air_of_air": felt / air,
            "light": light,
            "light_missed": missed / light,
            "runs_with_a_silent_failure": float(np.mean([run.silent_episodes > 0 for run in mine])),
            "contacts_counted": float(np.mean([run.contacts for run in mine])),
        })  # fmt: skip
    return rows


def lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    """The summary as a Markdown table."""
    noted = [name.removeprefix("after_") for name in rows[0]["error_mm"]]
    after = [f"median (p90) mm, < 5 mm after {n}" for n in noted]
    judged = [name for name, e in rows[0]["error_mm"].items() if "overlooked" in e][-2:]
    lost = [f"not found {name.replace('_', ' ')}, overlooked" for name in judged]
    head = ["skin, object", *after, *lost, "felt in the air", "light ones missed", "silent"]
    yield "| " + " | ".join(head) + " |"
    yield "|---" * len(head) + "|"
    for row in rows:
        errors = [
            f"{_mm(e['median'])} ({_mm(e['p90'])}), {e['under_5_mm']:.0%}"
            for e in row["error_mm"].values()
        ]
        cells = [
            f"{row['skin']}, {row['object']}",
            *errors,
            *(f"{e['not_found']}, {e['overlooked']}" for e in map(row["error_mm"].get, judged)),
            f"{row['felt_in_air_of_scans']:.1%}",
            f"{row['light_missed']:.0%} of {row['light']}",
            f"{row['runs_with_a_silent_failure']:.1%}",
        ]
        yield "| " + " | ".join(cells) + " |"


def write(path: Path, plan: Plan, runs: list[TouchRun]) -> None:
    """Summary and runs, a run a line: a diff can be read."""
    head = {
        "plan": {**asdict(plan), "presses": PRESSES, "pairs": PAIRS, "after": AFTER},
        "summary": summary(runs),
    }
    text = json.dumps(head, indent=1).removesuffix("\n}")
    each = ",\n  ".join(json.dumps(asdict(run)) for run in runs)
    path.write_text(f'{text},\n "runs": [\n  {each}\n ]\n}}\n', encoding="utf-8")


def read(path: Path) -> list[dict[str, Any]]:
    """The summary of such a file."""
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["summary"]
    return rows


def _mm(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def _scenario(job: Job) -> Scenario:
    name, skin, _ = job
    return scenario.load("demo").touching(name).on(skin)


def _play(filter_keys: str, job: Job) -> TouchRun:
    return touch_runs.play(_scenario(job), job[2], filter_keys)


def _quantile(values: Any, share: float) -> float:
    return round(float(np.quantile(values, share)), 3)
