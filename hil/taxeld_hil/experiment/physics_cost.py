"""What the soft skin costs the daemon: the final error on the fake clock, effect by effect.

Kinds of physics are interleaved seed by seed. A seed has the same object pose, path, baselines and
gains under all of them.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taxeld.config.toml_tables import Given
from taxeld.estimator.estimate import Status
from taxeld.model.symmetry import SILENT_MM
from taxeld_hil.experiment.physics_gap import SCAN_S
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario.mesh_config import PLAIN, MeshConfig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import robot
from taxeld_hil.world.world import load_model, make_world
from taxeld_protocol.modules import wired

BAD_MM = 10.0
OFF = {name: getattr(PLAIN, name) for name in (
    "taxel_radius_m", "sag_m", "bend", "onset", "hysteresis", "residue", "residue_slow",
    "cross_talk", "drift_counts_per_min",
)}  # fmt: skip


def _with(*names: str) -> Given[MeshConfig]:
    """These effects on, the others off."""
    return Given({name: value for name, value in OFF.items() if name not in names})


SOFT = ("taxel_radius_m", "sag_m")
BENT = (*SOFT, "bend", "onset")
FOAM = (*BENT, "hysteresis", "residue", "residue_slow")
KINDS: dict[str, tuple[str, Given[MeshConfig]]] = {  # the skin, and its keys
    "scene": ("scene", Given()),
    "3-D distance": ("typical", _with()),
    "+ area, sag": ("typical", _with(*SOFT)),
    "+ response": ("typical", _with(*BENT)),
    "+ foam": ("typical", _with(*FOAM)),
    "typical": ("typical", Given()),
    "poor": ("poor", Given()),
}


@dataclass(frozen=True, slots=True)
class RunResult:
    """How one run on the fake clock ended."""

    object: str
    kind: str
    seed: int
    final_mm: float
    contacts: int  # that the daemon counted
    converged: bool
    silent: bool  # a silent failure at some contact's end


def runs(
    scenario: Scenario, objects: list[str], seeds: int, filter_keys: str
) -> Iterator[RunResult]:
    """Every kind on every object, seed by seed; `filter_keys`: TOML for the daemon's [filter]."""
    for seed in range(seeds):
        for name in objects:
            for kind in KINDS:
                yield run(of(scenario, name, kind), kind, seed, filter_keys)


def of(scenario: Scenario, name: str, kind: str) -> Scenario:
    """The scenario with another object, on a skin of this kind."""
    physics, keys = KINDS[kind]
    return replace(scenario, bundle=name, physics=physics, mesh=keys)


def run(scenario: Scenario, kind: str, seed: int, filter_keys: str) -> RunResult:
    fake = FakeRun(scenario, seed, filter_keys=filter_keys)
    ends, last = fake.run(), fake.judge.last
    assert last is not None  # noqa: S101  (a run has many estimates)
    return RunResult(
        object=scenario.bundle,
        kind=kind,
        seed=seed,
        final_mm=fake.judge.error_mm(last.map),
        contacts=last.contacts,
        converged=last.status == Status.CONVERGED,
        silent=any(
            end.estimate.status == Status.CONVERGED and end.error_mm > SILENT_MM for end in ends
        ),
    )


def summary(done: list[RunResult]) -> list[dict[str, Any]]:
    """A row for each object and kind, in the order of the runs."""
    rows = []
    for name, kind in dict.fromkeys((r.object, r.kind) for r in done):
        mine = [r for r in done if (r.object, r.kind) == (name, kind)]
        final = np.array([r.final_mm for r in mine])
        q10, median, q90 = np.percentile(final, (10, 50, 90))
        rows.append({
            "object": name,
            "kind": kind,
            "seeds": len(mine),
            "final_mm": {"q10": q10, "median": median, "q90": q90, "max": float(final.max())},
            "under_10_mm": float(np.mean(final < BAD_MM)),
            "converged": float(np.mean([r.converged for r in mine])),
            "silent_failures": float(np.mean([r.silent for r in mine])),
            "contacts": float(np.mean([r.contacts for r in mine])),
            "finals_mm": [round(float(e), 3) for e in final],
        })  # fmt: skip
    return rows


def scan_ms(scenario: Scenario, seed: int) -> dict[str, float]:
    """CPU time of a scan along the scenario's path, whole and where the skin is touched [ms]."""
    model = load_model(scenario)
    made = make_world(scenario, model, wired(model.layout.uid.tolist()), seed)
    path = robot.plan(scenario, model, made.truth, seed)
    spent, top = [], []
    for t in np.arange(0.0, path.duration_s, SCAN_S):
        start = time.thread_time_ns()
        counts = made.counts(path.at(t), t)
        spent.append((time.thread_time_ns() - start) / 1e6)
        top.append(max(counts))
    cost, most = np.array(spent), np.array(top)
    touched = most > np.median(most) + 1000
    return {"mean": float(cost.mean()), "touched": float(cost[touched].mean()),
            "touched_share": float(touched.mean())}  # fmt: skip
