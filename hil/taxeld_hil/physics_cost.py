"""What honest physics cost the daemon: the final error on the fake clock, effect by effect.

Kinds of physics are interleaved seed by seed; a seed has the same object, path, baselines and gains
under all.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taxeld import bundle, layout
from taxeld.estimate import Status
from taxeld_hil import robot
from taxeld_hil.physics import MeshConfig
from taxeld_hil.scenario import Scenario
from taxeld_hil.simulate import SCAN_PERIOD_S, Simulation, configured
from taxeld_hil.world import world
from taxeld_protocol.modules import wired

BAD_MM = 10.0
SILENT_MM = 20.0  # a converged estimate that is off by more has failed in silence
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
class Run:
    """How one simulated session ended."""

    object: str
    kind: str
    seed: int
    final_mm: float
    contacts: int  # that the daemon counted
    converged: bool
    silent: bool  # at some contact's end
    by_contact_mm: tuple[float, ...]


def runs(scenario: Scenario, objects: list[str], seeds: int, config: str = "") -> Iterator[Run]:
    """Every kind on every object, seed by seed; `config` is TOML for the daemon."""
    for seed in range(seeds):
        for name in objects:
            for kind, mesh in KINDS.items():
                yield run(of(scenario, name, mesh), name, kind, seed, config)


def of(scenario: Scenario, name: str, mesh: MeshConfig | None) -> Scenario:
    """The scenario with another object and physics; None is the estimator's own."""
    physics = "scene" if mesh is None else "mesh"
    return replace(scenario, bundle=name, physics=physics, mesh=mesh or FULL)


def run(scenario: Scenario, name: str, kind: str, seed: int, config: str = "") -> Run:
    simulation = Simulation(scenario, seed, configured(scenario, seed, config))
    ends: list[tuple[float, bool]] = []
    before = False
    for step in simulation.steps():
        now = step.estimate
        if before and not now.contact:
            ends.append((step.error_mm, now.status == Status.CONVERGED))
        before = now.contact
    return Run(
        object=name,
        kind=kind,
        seed=seed,
        final_mm=step.error_mm,
        contacts=now.contacts,
        converged=now.status == Status.CONVERGED,
        silent=any(sure and error > SILENT_MM for error, sure in ends),
        by_contact_mm=tuple(round(error, 3) for error, _ in ends),
    )


def summary(done: list[Run]) -> list[dict[str, Any]]:
    """A row an object and kind, in the order of the runs."""
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
    skin = layout.load(scenario.layout)
    model = bundle.load(scenario.bundle, skin, 0.005).model
    made = world(scenario, model, wired(skin.uid.tolist()), seed)
    path = robot.plan(scenario, model, made.truth, seed)
    spent, top = [], []
    for t in np.arange(0.0, path.duration_s, SCAN_PERIOD_S):
        start = time.thread_time_ns()
        counts = made.counts(path.at(t), t)
        spent.append((time.thread_time_ns() - start) / 1e6)
        top.append(max(counts))
    cost, most = np.array(spent), np.array(top)
    touched = most > np.median(most) + 1000
    return {"mean": float(cost.mean()), "touched": float(cost[touched].mean()),
            "touched_share": float(touched.mean())}  # fmt: skip
