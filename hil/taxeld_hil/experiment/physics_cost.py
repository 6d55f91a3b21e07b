"""What the soft skin costs the daemon: the final error on the fake clock, effect by effect.

Kinds of physics are interleaved seed by seed. A seed has the same object pose, path, baselines and
gains under all of them.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taxeld.estimator.estimate import Status
from taxeld.model.symmetry import SILENT_MM
from taxeld_hil.experiment.physics_gap import SCAN_S
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario.mesh_config import MeshConfig
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import robot
from taxeld_hil.world.world import load_model, make_world
from taxeld_protocol.modules import wired

BAD_MM = 10.0
FULL = MeshConfig()
HARD = MeshConfig(taxel_radius_m=0.0, sag_m=0.0, closing=0.0, hysteresis=0.0, creep=0.0,
                  cross_talk=0.0, drift_counts_per_min=0.0)  # fmt: skip
SOFT = replace(HARD, taxel_radius_m=FULL.taxel_radius_m, sag_m=FULL.sag_m)
BENT = replace(SOFT, closing=FULL.closing)
FOAM = replace(BENT, hysteresis=FULL.hysteresis, creep=FULL.creep)
KINDS: dict[str, MeshConfig | None] = {
    "scene": None,
    "3-D distance": HARD,
    "+ area, sag": SOFT,
    "+ condenser": BENT,
    "+ foam": FOAM,
    "all (mesh)": FULL,
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
            for kind, mesh in KINDS.items():
                yield run(of(scenario, name, mesh), kind, seed, filter_keys)


def of(scenario: Scenario, name: str, mesh: MeshConfig | None) -> Scenario:
    """The scenario with another object and physics; None is the estimator's own."""
    physics = "scene" if mesh is None else "mesh"
    return replace(scenario, bundle=name, physics=physics, mesh=mesh or FULL)


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
