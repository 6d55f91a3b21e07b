"""`taxeld-hil physics`: the two models of a skin side by side, as JSON and a picture."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.errors import SetupError
from taxeld.model.observation import Noise
from taxeld_hil.experiment import physics_gap
from taxeld_hil.scenario import scenario, settings
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
    skin: str = "typical"
    contacts: int = 2000  # with each object
    seed: int = 0  # of the contacts
    noise_sigma: float = FilterConfig().noise_sigma  # that the daemon assumes

    @classmethod
    def quick(cls, objects: tuple[str, ...], contacts: int = 60, **keys: Any) -> Self:
        return cls(objects, contacts=contacts, **keys)


def experiment(plan: Plan, out: Path, say: Say) -> Iterator[Path]:
    """Measure, and write `physics.json` and `physics.png` into the directory `out`.

    Raises:
        SetupError: an object has no mesh here; or, with the JSON written, nothing to draw with.
    """
    if plan.contacts < LEAST_CONTACTS:
        raise SetupError(f"--contacts must be at least {LEAST_CONTACTS}")
    base = scenario.load("demo").on(plan.skin)
    if base.physics == "scene":
        raise SetupError("--skin scene: is no soft skin; it is what soft skins are compared with")
    filter_keys = f"noise_sigma = {plan.noise_sigma}"
    settings.on_a_fake_clock(base, plan.seed, filter_keys)  # faults in it are raised at once
    result = {
        "plan": asdict(plan),
        "mesh": asdict(base.skin),
        "gap": {name: _gap(base.touching(name), plan, say) for name in plan.objects},
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


def lines(path: Path) -> Iterator[str]:
    """Such a JSON file's effects as a Markdown table, a column an object."""
    gaps = json.loads(path.read_text(encoding="utf-8"))["gap"]
    heads = [f"{name}: bias, sd, correlation" for name in gaps]
    alone = f"this effect alone changes (rms): {', '.join(gaps)}"
    yield "| up to | " + " | ".join([*heads, alone]) + " |"
    yield "|---" * (len(gaps) + 2) + "|"
    for same in zip(*(gap["stages"] for gap in gaps.values()), strict=True):
        each = [f"{s['bias']:+.3f}, {s['sd']:.3f}, {s['correlation']:.3f}" for s in same]
        own = ", ".join(f"{s['step_rms']:.3f}" for s in same)
        yield f"| {same[0]['stage']} | " + " | ".join([*each, own]) + " |"


def _gap(base: Scenario, plan: Plan, say: Say) -> dict[str, Any]:
    model = load_model(base)

    def progress(done: int) -> None:
        if done * STEPS % plan.contacts < STEPS:
            say(f"{base.bundle}: {done} of {plan.contacts} contacts")

    solid = solid_of(base.bundle, model.layout)
    skins = physics_gap.SkinComparison(base, model, solid)
    readings = skins.readings(plan.contacts, np.random.default_rng(plan.seed), progress)
    return physics_gap.compare(readings, model.layout, Noise(plan.noise_sigma))


def _rounded(value: Any) -> Any:
    """Floats to five digits: more would be noise in a file that is kept."""
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value
