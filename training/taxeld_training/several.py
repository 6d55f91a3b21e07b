"""`taxeld-train build A B …`: a bundle of each object, and which of them no touch tells apart."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.config.tables import OBJECTS_MAX
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals import manifest
from taxeld.proposals.analytic import check_contacts
from taxeld_hil.objects import bundles, meshes, scenes
from taxeld_training.filters import alike

ALIKE = "alike.json"


def places(names: Sequence[str], out: Path) -> dict[str, Path]:
    """The directory of each object's bundle, in `out`.

    Raises:
        SetupError: there are too many objects, or two of a name, or a place is taken.
    """
    if len(names) > OBJECTS_MAX:
        raise SetupError(f"OBJECT: {len(names)} objects; name {OBJECTS_MAX} at most")
    for stem, count in Counter(Path(name).stem for name in names).items():
        if count > 1:
            raise SetupError(f"OBJECT: '{stem}' {count} times; name each object once")
    if (out / manifest.NAME).exists():
        raise SetupError(f"--out: {out} is a bundle; name a directory for several")
    found = {name: out / Path(name).stem for name in names}
    for place in found.values():
        bundles.check_place(place)
    return found


def check(names: Sequence[str], layout: Layout, height_m: float, depth_m: float) -> None:
    """Raises SetupError where an object cannot be used, or the skin misses it."""
    for name in names:
        try:
            mesh = meshes.load(meshes.find(name)[0])
            scene = scenes.build(mesh, layout, height_m)
            check_contacts(ObservationModel(scene, layout, depth_m))
        except SetupError as error:
            fault = str(error)
            raise SetupError(fault if fault.startswith(name) else f"{name}: {fault}") from None


def tell_pairs(told: dict[str, Any], out: Path) -> Iterator[str]:
    """Write how many touches part each pair into `out`; → a line for each pair that is alike, and
    for the one that parts last."""
    text = ",\n".join(f"  {json.dumps(row)}" for row in told["pairs"])
    head = json.dumps({key: value for key, value in told.items() if key != "pairs"})
    (out / ALIKE).write_text(f'{head[:-1]}, "pairs": [\n{text}\n]}}\n', encoding="utf-8")
    yield from alike.lines(told)
    parted = [row for row in told["pairs"] if not row["alike"]]
    if parted:
        last = max(parted, key=lambda row: (row["q90"] or np.inf, row["median"]))
        most = last["q90"] or f"more than {told['touches']}"
        yield (
            f"parts last {last['object']} and {last['other']}: {last['median']} touches in half of "
            f"the trials, {most} in nine of ten"
        )


def size_line(folder: Path) -> str:
    """What was made in the directory of a bundle."""
    info = json.loads((folder / manifest.NAME).read_text(encoding="utf-8"))
    size = sum(path.stat().st_size for path in folder.iterdir())
    return f"made       {folder}: {info['object']} on {info['layout']['name']}, {size / 1e6:.1f} MB"


def key_line(folders: Sequence[Path]) -> str:
    """The key of the configuration that names all bundles."""
    return f"scene.bundles = {json.dumps([str(folder) for folder in folders])}"
