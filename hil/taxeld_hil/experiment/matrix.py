"""`taxeld-hil matrix`: scenarios on objects and skins, seed by seed: which are found, as JSON."""

import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from taxeld.errors import SetupError
from taxeld_hil.experiment.jobs import Memory, digest, played
from taxeld_hil.grade.grade import Grade
from taxeld_hil.run.fake_run import NOT_INJECTED, FakeRun
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.world import load_model

Say = Callable[[str], None]


@dataclass(frozen=True)
class Plan:
    """What is run."""

    scenarios: tuple[str, ...]
    objects: tuple[str, ...] = ("box", "mug")  # bundles
    skins: tuple[str, ...] = ("scene", "typical", "poor")
    seeds: int = 5
    real: bool = False  # what no fake clock can do, in real time


class Job(NamedTuple):
    scenario: str
    bundle: str
    skin: str
    seed: int
    real: bool  # clock

    @property
    def subject(self) -> Scenario:
        return scenario.load(self.scenario).touching(self.bundle).on(self.skin)


@dataclass(frozen=True)
class Outcome:
    """Of one run; the grade of a single one says more."""

    scenario: str
    bundle: str
    skin: str
    seed: int
    real: bool
    passed: bool  # all checks
    found: bool  # converged and as near as the scenario asks, in the end
    error_mm: float | None  # then, up to symmetry
    status: str
    contacts: int  # that the daemon counted
    silent: int  # episodes: valid, converged and more than 20 mm off
    failed: tuple[str, ...]  # checks

    @property
    def job(self) -> Job:
        return Job(self.scenario, self.bundle, self.skin, self.seed, self.real)


def experiment(plan: Plan, out: Path, memory: Path, workers: int, say: Say) -> list[Outcome]:
    """Run them, and write `scenarios.json` into the directory `out`; runs are remembered in
    `memory`.

    Raises:
        SetupError: there are faults in the plan, an object has no mesh here, a process failed, or
            the memory cannot be written.
    """
    if plan.seeds < 1 or workers < 1:
        raise SetupError("--seeds and --workers must be at least 1")
    for name in plan.objects:  # each mesh is built once, and not by every worker
        model = load_model(scenario.load("demo").touching(name))
        if plan.skins != ("scene",):
            solid_of(name, model.layout)
    wanted = list(_jobs(plan))
    codes = {job: digest(job.subject) for job in wanted}
    with Memory(memory) as remembered:
        known = map(_outcome_of, remembered.rows(set(codes.values())))
        done = {outcome.job: outcome for outcome in known}
        todo = [job for job in wanted if job not in done]
        if len(todo) < len(wanted):
            say(f"{len(wanted) - len(todo)} of {len(wanted)} runs are remembered in {memory}")
        for k, outcome in enumerate(played(_play, todo, workers), 1):
            done[outcome.job] = outcome
            remembered.add(codes[outcome.job], asdict(outcome))
            say(f"{k} of {len(todo)}: {line(outcome)}")
    outcomes = [done[job] for job in wanted]
    out.mkdir(parents=True, exist_ok=True)
    write(out / "scenarios.json", plan, outcomes)
    return outcomes


def line(outcome: Outcome) -> str:
    """An outcome in short."""
    error = "no estimate" if outcome.error_mm is None else f"{outcome.error_mm:.1f} mm"
    name, where = outcome.scenario, f"{named(outcome.bundle)}, {outcome.skin}"
    clock = ", real time" if outcome.real else ""
    failed = f"; failed: {', '.join(outcome.failed)}" if outcome.failed else ""
    return f"{name}, {where}, seed {outcome.seed}{clock}: {outcome.status}, {error}{failed}"


def named(bundle: str) -> str:
    """An object's name: of a bundle that is not shipped its directory's."""
    return Path(bundle).name


def summary(outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """A row for each skin and object, in the order of the runs."""
    rows = []
    for skin, bundle in dict.fromkeys((o.skin, o.bundle) for o in outcomes):
        mine = [o for o in outcomes if (o.skin, o.bundle) == (skin, bundle)]
        rows.append({
            "skin": skin,
            "object": named(bundle),
            "runs": len(mine),
            "passed": sum(o.passed for o in mine),
            "found": sum(o.found for o in mine),
            "silent": sum(o.silent > 0 for o in mine),
        })  # fmt: skip
    return rows


def lines(outcomes: list[Outcome]) -> Iterator[str]:
    """How often each scenario's object was found, as a Markdown table: a column a skin and object;
    with the runs in which a check failed though it was found, and those that failed silently."""
    columns = list(dict.fromkeys((o.skin, o.bundle) for o in outcomes))
    heads = [f"{skin}, {named(bundle)}" for skin, bundle in columns]
    yield "| scenario | " + " | ".join(heads) + " |"
    yield "|---" * (len(columns) + 1) + "|"
    for name in dict.fromkeys(o.scenario for o in outcomes):
        cells = [
            _cell([o for o in outcomes if (o.scenario, o.skin, o.bundle) == (name, *column)])
            for column in columns
        ]
        yield f"| {name} | " + " | ".join(cells) + " |"
    all_of = [_cell([o for o in outcomes if (o.skin, o.bundle) == column]) for column in columns]
    yield "| **all** | " + " | ".join(all_of) + " |"


def write(path: Path, plan: Plan, outcomes: list[Outcome]) -> None:
    """Summary and outcomes, a run a line: a diff can be read."""
    head = {"plan": asdict(plan), "summary": summary(outcomes)}
    text = json.dumps(head, indent=1).removesuffix("\n}")
    each = ",\n  ".join(json.dumps(asdict(outcome)) for outcome in outcomes)
    path.write_text(f'{text},\n "runs": [\n  {each}\n ]\n}}\n', encoding="utf-8")


def read(path: Path) -> list[Outcome]:
    """The outcomes in such a file."""
    rows = json.loads(path.read_text(encoding="utf-8"))["runs"]
    return [_outcome_of(row) for row in rows]


def _cell(mine: list[Outcome]) -> str:
    found = sum(o.found for o in mine)
    failed, silent = sum(o.found and not o.passed for o in mine), sum(o.silent > 0 for o in mine)
    notes = [f"{failed} failed" * bool(failed), f"{silent} silent" * bool(silent)]
    return ", ".join([f"{found} of {len(mine)}", *filter(None, notes)])


def _jobs(plan: Plan) -> Iterator[Job]:
    """Seed by seed, so that a part of them is as fair as all."""
    for seed in range(plan.seeds):
        for name in plan.scenarios:
            asked = scenario.load(name)
            real = plan.real and any(fault.kind in NOT_INJECTED for fault in asked.fault)
            for skin in plan.skins:
                for bundle in plan.objects:
                    yield Job(name, bundle, asked.on(skin).physics, seed, real)


def _play(job: Job) -> Outcome:
    subject, name = job.subject, Path(job.scenario).stem
    if job.real:
        with tempfile.TemporaryDirectory(prefix="taxeld-") as place:
            run = LiveRun(name, subject, job.seed, Path(place) / "session", "", _silence)
            grade = run.graded(Path(place))
    else:
        grade = FakeRun(subject, job.seed).graded(name)
    return _outcome(job, grade, subject.expect.error_mm)


def _outcome(job: Job, grade: Grade, error_mm: float) -> Outcome:
    figures = grade.figures
    error = figures["error_mm"]
    return Outcome(
        *job,
        passed=grade.passed,
        found=figures["status"] == "converged" and error is not None and error < error_mm,
        error_mm=None if error is None else round(error, 3),
        status=figures["status"],
        contacts=figures["contacts"],
        silent=figures["silent_failures"]["episodes"],
        failed=tuple(check.name for check in grade.checks if check.passed is False),
    )


def _outcome_of(row: dict[str, Any]) -> Outcome:
    """As JSON has it."""
    return Outcome(**{**row, "failed": tuple(row["failed"])})


def _silence(_: str) -> None:
    """The contacts of a run are not printed."""
