"""`taxeld-hil physics --touches`: ten touches on soft skins, seed by seed, as JSON.

Seeds run side by side, one thread a worker. Each is remembered with a digest of the code that it
ran on, so that a measurement that was cut short goes on, and one of other code begins anew.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from importlib import resources
from multiprocessing import get_context
from pathlib import Path
from typing import IO, Any

import numpy as np

from taxeld.errors import SetupError
from taxeld_hil.experiment import touch_runs
from taxeld_hil.experiment.touch_runs import AFTER, PAIRS, PRESSES, TouchRun
from taxeld_hil.scenario import scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.world import load_model

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
FOUND_MM, NEAR_MM = 5.0, 10.0
QUICK_SEEDS = 2

Say = Callable[[str], None]


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
            raise SetupError("--skin scene: no soft skin; its taxels have no depth of their own")
    for name in plan.objects:  # each mesh is built once, and not by every worker
        solid_of(name, load_model(replace(base, bundle=name)).layout)
    wanted = [
        (name, skin, seed)
        for seed in range(plan.seeds)
        for skin in plan.skins
        for name in plan.objects
    ]
    code = digest(plan.filter_keys)
    done = remembered(memory, code)
    todo = [each for each in wanted if each not in done]
    if len(todo) < len(wanted):
        say(f"{len(wanted) - len(todo)} of {len(wanted)} runs are remembered in {memory}")
    with opened(memory) as file:
        for run in _played(todo, plan.filter_keys, workers):
            done[run.object, run.skin, run.seed] = run
            file.write(json.dumps({"code": code, **asdict(run)}) + "\n")
            file.flush()
            say(f"{run.object}, {run.skin}, seed {run.seed}: {run.error_mm} mm after {AFTER}")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "touches.json"
    write(path, plan, [done[each] for each in wanted])
    return path


def digest(filter_keys: str) -> str:
    """Of the code and the bundles that a run depends on."""
    found = hashlib.sha256(filter_keys.encode())
    for package in ("taxeld", "taxeld_protocol", "taxeld_hil"):
        root = Path(str(resources.files(package)))
        for path in sorted(root.rglob("*")):
            if path.suffix in (".py", ".toml", ".npz", ".onnx") and path.is_file():
                found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return found.hexdigest()[:16]


def remembered(memory: Path, code: str) -> dict[tuple[str, str, int], TouchRun]:
    """The runs of this code in a file of a run a line; a last line that was cut short is none."""
    found = {}
    lines = memory.read_text(encoding="utf-8").splitlines() if memory.is_file() else []
    for line in lines:
        try:
            row = json.loads(line)
            if row.pop("code") == code:
                run = TouchRun(**row)
                found[run.object, run.skin, run.seed] = run
        except (ValueError, KeyError, TypeError, AttributeError):
            continue  # it is measured again
    return found


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
                    "under_5_mm": float(np.mean(error[:, k] < FOUND_MM)),
                    "under_10_mm": float(np.mean(error[:, k] < NEAR_MM)),
                    "converged": float(np.mean([run.converged[k] for run in mine])),
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
    after = [f"{what} after {n}" for n in AFTER for what in ("median (p90) mm, < 5 mm",)]
    head = ["skin, object", *after, "felt in the air", "light ones missed", "silent"]
    yield "| " + " | ".join(head) + " |"
    yield "|---" * len(head) + "|"
    for row in rows:
        errors = [
            f"{e['median']:.3g} ({e['p90']:.3g}), {e['under_5_mm']:.0%}"
            for e in row["error_mm"].values()
        ]
        cells = [
            f"{row['skin']}, {row['object']}",
            *errors,
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


def opened(memory: Path) -> IO[str]:
    """To add runs to."""
    try:
        memory.parent.mkdir(parents=True, exist_ok=True)
        return memory.open("a", encoding="utf-8")
    except OSError as error:
        raise SetupError(f"--memory: {memory}: {error.strerror}") from None


def _played(todo: list[tuple[str, str, int]], filter_keys: str, workers: int) -> Iterator[TouchRun]:
    """In any order."""
    if workers <= 1 or len(todo) <= 1:
        yield from (_play(*each, filter_keys) for each in todo)
        return
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")  # inherited by the workers
    with ProcessPoolExecutor(min(workers, len(todo)), get_context("spawn")) as pool:
        try:
            jobs = [pool.submit(_play, *each, filter_keys) for each in todo]
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _play(name: str, skin: str, seed: int, filter_keys: str) -> TouchRun:
    base = replace(scenario.load("demo"), bundle=name, physics=skin)
    return touch_runs.play(base, seed, filter_keys)


def _quantile(values: Any, share: float) -> float:
    return round(float(np.quantile(values, share)), 3)
