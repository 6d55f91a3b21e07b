"""Rules of the whole house."""

import json
import re
import tomllib
from pathlib import Path

import pytest
from deploy import manuals

from taxeld import __version__
from taxeld.config import file as config_file
from taxeld.proposals import bundle

from ..import_directions import EVERYWHERE, MOST, ROOMS, House


def test_rooms_import_as_their_table_says() -> None:
    assert House().faults() == []


def test_the_table_has_no_circle() -> None:
    for rooms in ROOMS.values():
        known = set(EVERYWHERE)
        for room, allowed in rooms.items():
            assert set(allowed.split()) <= known, room
            known.add(room)


def faults(root: Path, files: dict[str, str]) -> list[str]:
    """What the guard finds in a project of these files."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    return House(root).faults()


def test_a_package_that_imports_one_above_it_is_found(tmp_path: Path) -> None:
    assert faults(
        tmp_path,
        {
            "firmware_protocol/taxeld_protocol/bad.py": "import taxeld.config\n",
            "daemon/taxeld/model/bad.py": "\nimport torch.nn\n",
            "daemon/taxeld/stream/bad.py": "from taxeld_ros2 import bridge\n",
            "hil/taxeld_hil/run/bad.py": "from taxeld_training import build\n",
            "ros2/taxeld_ros2/bad.py": "import taxeld_hil.world\n",
        },
    ) == [
        "firmware_protocol/taxeld_protocol/bad.py:1: taxeld_protocol may not import taxeld",
        "daemon/taxeld/model/bad.py:2: taxeld may not import torch",
        "daemon/taxeld/stream/bad.py:1: taxeld may not import taxeld_ros2",
        "hil/taxeld_hil/run/bad.py:1: taxeld_hil may not import taxeld_training",
        "ros2/taxeld_ros2/bad.py:1: taxeld_ros2 may not import taxeld_hil",
    ]


def test_a_room_that_imports_one_above_it_is_found_also_inside_a_function(tmp_path: Path) -> None:
    assert faults(
        tmp_path,
        {
            "daemon/taxeld/skin/skin.py": "",
            "daemon/taxeld/estimator/bad.py": "import math\nfrom taxeld.skin import skin\n",
            "daemon/taxeld/model/bad.py": "def f():\n    from taxeld.skin.skin import Skin\n",
            "daemon/taxeld/attic/old.py": "",
        },
    ) == [
        "daemon/taxeld/attic/old.py:1: room attic of taxeld is not in the table",
        "daemon/taxeld/estimator/bad.py:2: room estimator may not import room skin",
        "daemon/taxeld/model/bad.py:2: room model may not import room skin",
    ]


def test_a_pure_module_that_reaches_a_file_over_others_is_found(tmp_path: Path) -> None:
    assert faults(
        tmp_path,
        {
            "daemon/taxeld/model/scene.py": "from taxeld.layout.layout import Layout\n",
            "daemon/taxeld/layout/layout.py": "def f():\n    from taxeld.layout import files\n",
            "daemon/taxeld/layout/files.py": "from pathlib import Path\n",
            "daemon/taxeld/config/tables.py": "",
            "daemon/taxeld/config/__init__.py": "import os.path\n",
        },
    ) == [
        "daemon/taxeld/config/tables.py:1: must be pure, but imports taxeld.config → os",
        "daemon/taxeld/model/scene.py:1: must be pure, but imports "
        "taxeld.layout.layout → taxeld.layout.files → pathlib",
    ]


def test_a_module_that_imports_too_many_others_is_found(tmp_path: Path) -> None:
    names = [f"part_{k}" for k in range(MOST + 1)]
    files = {f"daemon/taxeld/layout/{name}.py": "" for name in names}
    text = "".join(f"from taxeld.layout import {name}\n" for name in [*names, names[0]])
    files |= {"daemon/taxeld/layout/bad.py": text, "daemon/taxeld/cli.py": text}
    assert faults(tmp_path, files) == [
        "daemon/taxeld/layout/bad.py:1: imports 13 modules of the project, not 12"
    ]


ROOT = Path(__file__).parents[2]


def test_the_version_is_the_same_wherever_it_stands() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == __version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\n## {__version__}\n" in changes


@pytest.mark.parametrize("program", manuals.PROGRAMS)
def test_the_readme_lists_every_command(program: str) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for name in manuals.commands_of(manuals.parser_of(program)):
        assert re.search(rf"`{program} {name}\b", text), name


def test_the_readme_lists_every_make_target() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for target in set(" ".join(lines).split()) - {"clean"}:
        assert f"`make {target}`" in text, target


def test_the_performance_pages_sampler_table_is_what_the_bundles_say() -> None:
    text = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    for name in ("box", "mug"):
        info = json.loads((bundle.find(name) / "bundle.json").read_text(encoding="utf-8"))
        known = {s["name"]: s for s in info["samplers"]} | info["analytic"]
        shown = ("projection", "table", "ddpm-100", "density-16", "density-64")
        figures = [*(known[name]["energy_distance"] for name in shown), info["energy_floor"]]
        assert f"| `{name}` | " + " | ".join(f"{f:.3f}" for f in figures) + " |" in text


def test_the_example_configuration_is_fine() -> None:
    assert config_file.load(ROOT / "examples" / "can0.toml").source.channel == "can0"
