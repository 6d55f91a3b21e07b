"""`taxeld-hil physics`: the two models of a skin side by side, as JSON and a picture."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.errors import SetupError
from taxeld.model.observation import Noise
from taxeld_hil.experiment import physics_cost, physics_gap
from taxeld_hil.scenario import scenario, settings
from taxeld_hil.scenario.mesh_config import TYPICAL
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.world import load_model

LEAST_CONTACTS = 8
STEPS = 10  # lines of progress for each object

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is measured."""

    objects: tuple[str, ...]  # bundles
    contacts: int = 2000  # with each object
    seeds: int = 20  # of runs with each object and kind of physics
    seed: int = 0  # of the contacts
    noise_sigma: float = FilterConfig().noise_sigma  # that the daemon assumes

    @classmethod
    def quick(cls, objects: tuple[str, ...], contacts: int = 60, seeds: int = 2, **keys: Any
              ) -> Self:  # fmt: skip
        return cls(objects, contacts, seeds, **keys)


def experiment(plan: Plan, out: Path, say: Say) -> Iterator[Path]:
    """Measure, and write `physics.json` and `physics.png` into the directory `out`.

    Raises:
        SetupError: an object has no mesh here; or, with the JSON written, nothing to draw with.
    """
    if plan.contacts < LEAST_CONTACTS or plan.seeds < 1:
        raise SetupError(f"--contacts must be at least {LEAST_CONTACTS}, --seeds at least 1")
    demo = replace(scenario.load("demo"), physics="typical")
    filter_keys = f"noise_sigma = {plan.noise_sigma}"
    settings.on_a_fake_clock(demo, plan.seed, filter_keys)  # faults in it are raised at once
    gaps = {name: _gap(demo, name, plan, say) for name in plan.objects}
    done: list[physics_cost.RunResult] = []
    for run in physics_cost.runs(demo, list(plan.objects), plan.seeds, filter_keys):
        done.append(run)
        if run.kind == list(physics_cost.KINDS)[-1]:
            say(f"{run.object}, seed {run.seed}, {run.kind}: {run.final_mm:.2f} mm")
    result = {
        "plan": asdict(plan),
        "mesh": asdict(TYPICAL),
        "gap": gaps,
        "cost": physics_cost.summary(done),
        "scan_cpu_ms": {name: _scan_ms(demo, name) for name in plan.objects},
    }
    out.mkdir(parents=True, exist_ok=True)
    path = out / "physics.json"
    path.write_text(json.dumps(_rounded(result), indent=1) + "\n", encoding="utf-8")
    yield path
    try:
        from taxeld_hil.experiment import physics_chart  # noqa: PLC0415  # the picture alone needs it
    except ImportError:
        cure = "pip install 'taxeld[view]'"
        raise SetupError(f"physics.png: drawing needs matplotlib; {cure}") from None
    physics_chart.draw(result, out / "physics.png")
    yield out / "physics.png"


def _scan_ms(demo: Scenario, name: str) -> dict[str, dict[str, float]]:
    return {
        kind: physics_cost.scan_ms(physics_cost.of(demo, name, kind), seed=0)
        for kind in ("scene", "typical")
    }


def _gap(demo: Scenario, name: str, plan: Plan, say: Say) -> dict[str, Any]:
    model = load_model(replace(demo, bundle=name))

    def progress(done: int) -> None:
        if done * STEPS % plan.contacts < STEPS:
            say(f"{name}: {done} of {plan.contacts} contacts")

    skins = physics_gap.SkinComparison(demo, model, solid_of(name, model.layout))
    readings = skins.readings(plan.contacts, np.random.default_rng(plan.seed), progress)
    return physics_gap.compare(readings, model.layout, Noise(plan.noise_sigma))


def _rounded(value: Any) -> Any:
    """Floats to five digits: more would be noise in a file that is kept."""
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value
