"""Scene bundles: a directory with the scene, its samplers, and what is known about them."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from taxeld import scene
from taxeld.errors import SetupError
from taxeld.ladder import Cost, Rung, Step
from taxeld.layout import Layout
from taxeld.observation import ObservationModel
from taxeld.proposals import Manifold, Projection, Proposal, Table
from taxeld.sampler import Sampler

FORMAT = 2
TIMED_CALLS = 5  # the median of which is what a proposal costs
SHARES = (0.5, 0.25)  # of the samples, where the cheapest sampler with all of them is too much

ANALYTIC: dict[str, Callable[[ObservationModel], Proposal]] = {
    "projection": Projection, "manifold": Manifold, "table": Table,
}  # fmt: skip

_KEYS = {
    "format": int,
    "object": str,
    "attribution": (str, type(None)),
    "layout": dict,
    "height_m": float,
    "depth_max_m": float,
    "samplers": list,
    "auto": list,
}


@dataclass(frozen=True, slots=True)
class Bundle:
    """A validated bundle that belongs to the configured layout."""

    path: Path
    info: dict[str, Any]  # bundle.json as it stands
    model: ObservationModel

    def proposal(
        self, name: str, sampler: str = "", samples: int = 100, budget_ms: float = 5.0
    ) -> Proposal:
        """The proposal that the configuration names.

        `auto` is the first of the bundle's own order of preference whose CPU time for `samples`
        samples fits `budget_ms`, or the cheapest where none does; a `sampler` is taken by its name,
        a kind of learned proposal (`density`, `ddpm`) as the bundle's first of that kind.

        Raises:
            SetupError: the bundle has none of that name.
        """
        samplers = {s["name"]: s for s in self.info["samplers"]}
        if sampler and sampler not in samplers:
            known = ", ".join(samplers) or "none"
            raise SetupError(f"filter.sampler: {self.path.name} has no '{sampler}'; it has {known}")
        if name in ANALYTIC:
            return ANALYTIC[name](self.model)
        if sampler:
            return self._learned(samplers[sampler])
        if name == "auto":
            return self._fitting(samples, budget_ms)
        for entry in samplers.values():
            if entry["kind"] == name:
                return self._learned(entry)
        raise SetupError(f"filter.proposal: {self.path.name} holds no {name} sampler; use auto")

    def _learned(self, entry: dict[str, Any]) -> Sampler:
        return Sampler(self.path / entry["file"], self.model.layout, entry["kind"])

    def ladder(self, chosen: Proposal, samples: int) -> list[Rung]:
        """The chosen proposal, and what stands in for it where time is short: cheaper samplers in
        the bundle's order of preference, fewer samples of the cheapest, the table if it is cheaper
        still, and none."""

        def rung(step: Step, proposal: Proposal, share: float = 1.0) -> Rung:
            ms = cpu_ms(proposal, self.model, max(round(share * samples), 1))
            return Rung(step, proposal, share, Cost(1e6 * ms))

        made = [rung(Step.CHOSEN, chosen)]
        for entry in self._cheaper_samplers(chosen):
            made += _cheaper(rung(Step.CHEAPER, self._learned(entry)), made[-1])
        last = made[-1].proposal
        assert last is not None  # noqa: S101  (none of these is)
        made += [rung(Step.FEWER, last, share) for share in SHARES]
        if chosen.name != Table.name:
            made += _cheaper(rung(Step.TABLE, Table(self.model)), made[-1])
        return [*made, Rung(Step.NONE)]

    def _cheaper_samplers(self, chosen: Proposal) -> list[dict[str, Any]]:
        """Of less work than a chosen one of them, in order of preference."""
        samplers = {s["name"]: s for s in self.info["samplers"]}
        preferred = [samplers[name] for name in self.info["auto"] if name in samplers]
        file = chosen.file if isinstance(chosen, Sampler) else ""
        most = next((s["flops"] for s in samplers.values() if s["file"] == file), 0)
        return [s for s in preferred if s["flops"] < most]

    def _fitting(self, samples: int, budget_ms: float) -> Proposal:
        made: list[tuple[float, Proposal]] = []
        for name in self.info["auto"]:
            proposal = self._named(name)
            cost = cpu_ms(proposal, self.model, samples)
            if cost <= budget_ms:
                return proposal
            made.append((cost, proposal))
        return min(made, key=lambda pair: pair[0])[1] if made else Table(self.model)

    def _named(self, name: str) -> Proposal:
        """One of the order of preference."""
        return self.proposal(name) if name in ANALYTIC else self.proposal("", name)


def _cheaper(rung: Rung, than: Rung) -> list[Rung]:
    return [rung] if rung.cost.ns < than.cost.ns else []


def cpu_ms(proposal: Proposal, model: ObservationModel, samples: int) -> float:
    """Median CPU time of a call [ms], the first left out."""
    rng = np.random.default_rng(0)
    taxels = len(model.layout)
    z, live = np.eye(1, taxels)[0], np.ones(taxels, dtype=bool)
    spent = []
    for _ in range(TIMED_CALLS + 1):
        start = time.thread_time_ns()
        proposal.propose(z, live, samples, rng)
        spent.append((time.thread_time_ns() - start) / 1e6)
    return float(np.median(spent[1:]))


def find(name: str) -> Path:
    """The directory of a shipped bundle's name or a path."""
    shipped = Path(str(resources.files("taxeld") / "bundles"))
    for path in (shipped / name, Path(name)):
        if (path / "bundle.json").is_file():
            return path
    names = ", ".join(sorted(p.name for p in shipped.glob("*") if (p / "bundle.json").is_file()))
    raise SetupError(
        f"scene.bundle: no bundle '{name}'; shipped are {names}; "
        "others are built by 'taxeld-train build'"
    )


def load(name: str, layout: Layout, depth_max_m: float) -> Bundle:
    """Load and validate a bundle for a skin.

    Raises:
        SetupError: it is missing, damaged, or of another layout or depth.
    """
    path = find(name)
    info = _info(path / "bundle.json")
    theirs = info["layout"]
    if theirs.get("digest") != layout.digest:
        raise SetupError(
            f"scene.bundle: {path.name} is for the layout {theirs.get('name')} "
            f"({theirs.get('digest')}), not for {layout.name} ({layout.digest})"
        )
    if abs(info["depth_max_m"] - depth_max_m) > 1e-6:
        raise SetupError(
            f"skin.full_scale_depth_m: is {depth_max_m:g}, but {path.name} was built for "
            f"{info['depth_max_m']:g}"
        )
    return Bundle(path, info, ObservationModel(scene.load(path / "scene.npz"), layout, depth_max_m))


def _info(path: Path) -> dict[str, Any]:
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SetupError(f"{path}: unreadable ({error}); build the bundle again") from None
    if not isinstance(info, dict) or info.get("format") != FORMAT:
        raise SetupError(f"{path}: is not of bundle format {FORMAT}; build the bundle again")
    for key, kind in _KEYS.items():
        if not isinstance(info.get(key), kind):  # type: ignore[arg-type]
            raise SetupError(f"{path}: {key} is missing or of the wrong type")
    for i, sampler in enumerate(info["samplers"]):
        if not isinstance(sampler, dict) or not {"name", "kind", "file"} <= sampler.keys():
            raise SetupError(f"{path}: samplers[{i}] needs a name, a kind and a file")
        file = str(sampler["file"])
        if Path(file).name != file or not (path.parent / file).is_file():
            raise SetupError(f"{path}: samplers[{i}].file: no such file {file} beside it")
    unknown = set(info["auto"]) - ANALYTIC.keys() - {s["name"] for s in info["samplers"]}
    if unknown:
        raise SetupError(f"{path}: auto: no such proposal or sampler: {sorted(unknown)[0]}")
    return info
