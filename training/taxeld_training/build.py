"""`taxeld-train build`: objects and a skin → bundles that the daemon runs."""

import json
import shlex
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.config.tables import OBJECTS_MAX, SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.proposals import manifest
from taxeld_sim.objects import bundles, meshes
from taxeld_sim.trials.case import TABLED, Method
from taxeld_training import candidates, closing, progress
from taxeld_training.models.variants import Variant
from taxeld_training.objects.report import doubts

SCENE = "scene"
STAGES = (SCENE, *candidates.STAGES, closing.STAGE)  # of a bundle with a sampler, in order
ALIKE = "alike.json"
AFTER = 6  # touches that the summary speaks of


@dataclass(frozen=True)
class Build:
    """Bundles of objects for the same links."""

    names: Sequence[str]  # YCB ids or mesh files
    layouts: Sequence[str]  # of each link, as `skin.layout`; samplers are of the first
    heights_m: Sequence[float]  # of each link's frame above the objects' lowest points
    depth_m: float  # of a press at full scale
    out: Path  # the bundle of one object; of several the directory of theirs
    samplers: Sequence[Variant]  # to be trained; none: the table of simulated contacts serves
    foam: str = "typical"  # of the trials at the end
    trials: int = closing.ENOUGH

    def run(self) -> Iterator[str]:
        """Build them; → lines on them. A bundle in an older one's place is moved there when it is
        complete.

        Raises:
            SetupError: an object or a skin cannot be used, or a place is taken.
        """
        began_s, places = time.monotonic(), self._places()
        for name in places:
            warn_of_doubts(name, self.layouts[0], self.heights_m[0])
        if len(places) > 1 and self.samplers:  # no object fails after the hours of those before it
            for name in places:
                with tempfile.TemporaryDirectory() as scratch:
                    self._write(name, Path(scratch))
        for number, (name, out) in enumerate(places.items(), 1):
            if len(places) > 1:
                say(f"{number}/{len(places)} {name}")
            yield from self._one(name, out)
        if len(places) > 1:
            with progress.shown((closing.PAIRS,), sys.stderr) as tell:
                folders, skin = list(places.values()), self.layouts[0]
                told = closing.pairs(folders, skin, self.foam, self.trials, tell)
            yield from pairs(told, self.out)
        yield f"took       {time.monotonic() - began_s:.0f} s"
        if len(places) > 1:
            yield f"scene.bundles = {json.dumps([str(folder) for folder in places.values()])}"

    @cached_property
    def _links(self) -> bundles.Links:
        skins = map(layouts.load, self.layouts)
        return list(zip(skins, self.heights_m, strict=True))

    def _places(self) -> dict[str, Path]:
        """The directory of each object's bundle."""
        if self.foam not in closing.FOAMS:
            known = ", ".join(closing.FOAMS)
            raise SetupError(f"--foam: no foam '{self.foam}'; there are {known}")
        places = {self.names[0]: self.out}
        if len(self.names) > 1:
            if len(self.names) > OBJECTS_MAX:
                raise SetupError(f"OBJECT: {len(self.names)} objects; name {OBJECTS_MAX} at most")
            for stem, count in Counter(Path(name).stem for name in self.names).items():
                if count > 1:
                    raise SetupError(f"OBJECT: '{stem}' {count} times; name each object once")
            if (self.out / manifest.NAME).exists():
                raise SetupError(f"--out: {self.out} is a bundle; name a directory for several")
            places = {name: self.out / Path(name).stem for name in self.names}
        for place in places.values():
            bundles.check_place(place)
        return places

    def _one(self, name: str, out: Path) -> Iterator[str]:
        stages = STAGES if self.samplers else (SCENE,)
        with progress.shown(stages, sys.stderr) as tell, bundles.replacing(out) as made:
            model = self._write(name, made)
            tell(SCENE, 1.0)
            if self.samplers:
                bundles.seal(made, candidates.make(model, self.samplers, made, tell))
                told = closing.counted(made, self.layouts[0], self.foam, self.trials, tell)
                bundles.seal(made, told)
        info = json.loads((out / manifest.NAME).read_text(encoding="utf-8"))
        for repair in info["repairs"]:
            say(f"taxeld-train: {name}: {repair}")
        yield from summary(out, info, self.layouts[0], is_one=len(self.names) == 1)

    def _write(self, name: str, made: Path) -> ObservationModel:
        try:
            return bundles.write(name, self._links, self.depth_m, made)
        except SetupError as error:
            fault = str(error)
            raise SetupError(fault if fault.startswith(name) else f"{name}: {fault}") from None


def command(name: str, layout: str, height_m: float, depth_m: float) -> str:
    """The command that builds a first bundle of an object on a layout."""
    words = ["taxeld-train", "build", name, *_layout(layout), "--height-m", f"{height_m:g}"]
    if depth_m != SkinConfig().full_scale_depth_m:
        words += ["--depth-mm", f"{1e3 * depth_m:g}"]
    return shlex.join([*words, "--table", "--out", Path(name).stem])


def summary(out: Path, info: dict[str, Any], layout: str, *, is_one: bool = True) -> Iterator[str]:
    """Lines on the bundle in `out`, whether its sampler pays, and, of one object, the next
    commands; `layout` as it was given."""
    size = sum(path.stat().st_size for path in out.iterdir())
    yield f"made       {out}: {info['object']} on {info['layout']['name']}, {size / 1e6:.1f} MB"
    if "touches" in info:
        samplers = ", ".join(one["name"] for one in info["samplers"])
        yield f"samplers   {samplers}; auto: {info['auto'][0]}"
        yield from _how_good(info)
    elif is_one:
        yield f"how good   {shlex.join(['taxeld-hil', 'expect', '--object', str(out)])}"
    if is_one:
        run = ["taxeld-hil", "run", "demo", "--object", str(out), *_layout(layout)]
        yield f"next       {shlex.join([*run, '--out', f'{out.name}_demo'])}"


def _how_good(info: dict[str, Any]) -> Iterator[str]:
    tried, usual = info["touches"], closing.size(TABLED)
    counts = {name: found[AFTER - 1] for name, found in tried["found_and_sure"].items()}
    wrong = {name: sum(of_touch) for name, of_touch in tried["misleading"].items()}
    table, own = (name for name in counts if name.endswith(usual))
    n, estimates = tried["trials"], tried["trials"] * len(tried["misleading"][own])
    sampler = info["samplers"][0]["name"]
    yield (
        f"how good   found and sure after {AFTER}: with {sampler} {counts[own]} of {n}, with the "
        f"table {counts[table]}"
    )
    yield (
        f"           {n} trials on {tried['foam']} foam; misleading: {wrong[own]} and "
        f"{wrong[table]} of {estimates} estimates"
    )
    if "filter" in info:
        size = info["filter"]
        chosen = Method(info["auto"][0], "", size["particles"], size["particles_max"])
        name = f"{chosen.proposal} {closing.size(chosen)}"
        yield (
            f"enough     {name} particles, {size['injected']} samples: {counts[name]} of {n}, "
            f"{wrong[name]} misleading"
        )


def pairs(told: dict[str, Any], out: Path) -> Iterator[str]:
    """Write how many touches part each pair into `out`; → a line for each pair that is alike,
    whichever of the two is touched, and for the one that parts last."""
    text = ",\n".join(f"  {json.dumps(row)}" for row in told["pairs"])
    head = json.dumps({key: value for key, value in told.items() if key != "pairs"})
    (out / ALIKE).write_text(f'{head[:-1]}, "pairs": [\n{text}\n]}}\n', encoding="utf-8")
    alike: dict[tuple[str, ...], float] = {}
    for row in told["pairs"]:
        if row["alike"]:
            both = tuple(sorted((row["object"], row["other"])))
            alike[both] = max(alike.get(both, 0.0), row["not_parted"])
    for (one, other), share in alike.items():
        yield (
            f"alike      {one} and {other}: {told['touches']} touches at these heights leave both "
            f"possible in {share:.0%} of {told['trials']} trials on {told['foam']} foam"
        )
    parted = [row for row in told["pairs"] if not row["alike"]]
    if parted:
        last = max(parted, key=lambda row: (row["q90"] or np.inf, row["median"]))
        most = last["q90"] or f"more than {told['touches']}"
        yield (
            f"parts last {last['object']} and {last['other']}: {last['median']} touches in half of "
            f"the trials, {most} in nine of ten"
        )


def warn_of_doubts(name: str, layout: str, height_m: float) -> None:
    """Warn of probable faults in how a mesh lies and is cut. Raises SetupError."""
    mesh = meshes.load(meshes.find(name)[0])
    for line in doubts(mesh, layouts.load(layout), height_m):
        say(f"taxeld-train: {name}: warning: {line}")


def say(line: str) -> None:
    """Write a line for the user beside the output."""
    sys.stderr.write(f"{line}\n")


def _layout(given: str) -> list[str]:
    """The option, but for the default."""
    return ["--layout", given] if given != SkinConfig().layout else []
