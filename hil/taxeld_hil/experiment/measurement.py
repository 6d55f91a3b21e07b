"""Measurements of many runs: their checks, the digest of their code, and their files."""

import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from taxeld.errors import SetupError
from taxeld.layout import read as layout_files
from taxeld.proposals import bundle, manifest
from taxeld_hil import jobs
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.bundled import solid_of
from taxeld_hil.world.world import load_model

RunRow: TypeAlias = dict[str, Any]  # one run's figures, as JSON has them


def require(
    objects: Sequence[str],
    skins: Sequence[str],
    seeds: int,
    layouts: Sequence[str] = ("",),
    *,
    soft: bool,
) -> None:
    """Check the asked objects, skins, layouts and seeds, and build each object's mesh once, before
    several workers need it; `soft`: only soft skins will do.

    Raises:
        SetupError: there is no such skin or layout, an object has no bundle or no mesh here, or
            there are no seeds.
    """
    if seeds < 1:
        raise SetupError("--seeds must be at least 1")
    demo = scenario.load("demo")
    physics = {demo.on(skin).physics for skin in skins}
    if soft and "scene" in physics:
        raise SetupError("--foam scene: is no soft skin; name typical, poor or stiff")
    for name in objects:
        for layout in layouts:
            model = load_model(demo.touching(name).on("", layout))
            if physics != {"scene"}:
                solid_of(name, model.layout)


def digest(subject: Scenario) -> str:
    """Hash of all that a run of a scenario depends on but its seed: code, scenario, bundle, and
    the content of a layout file.

    Raises:
        SetupError: the bundle or the file cannot be found or read.
    """
    info = manifest.read(bundle.find(subject.bundle) / manifest.NAME)  # has digests of its files
    text = f"{code()}\0{subject!r}\0{content(subject.layout)}"
    return hashlib.sha256(text.encode() + info).hexdigest()[:16]


def save(path: Path, runs: Sequence[RunRow], **about: Any) -> None:
    """Write runs as JSON, a run a line: a diff can be read; before them what is said `about` them,
    a value a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(map(json.dumps, runs))
    head = "".join(f"{json.dumps(key)}: {json.dumps(value)},\n" for key, value in about.items())
    path.write_text(f'{{{head}"runs": [\n{lines}\n]}}\n', encoding="utf-8")


@cache
def content(layout: str) -> str:
    """The digest of a layout file, or of a line; empty: of the bundle's own."""
    return layout_files.read(layout).digest if layout else ""


def code() -> str:
    """Hash of the code and of the files shipped with it."""
    packages = "taxeld", "taxeld_protocol", "taxeld_hil"
    return jobs.code(tuple(f"{name}/**/*.{end}" for name in packages for end in ("py", "toml")))
