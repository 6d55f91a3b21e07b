"""Rules of the whole house."""

import json
from pathlib import Path

from taxeld import bundle, config

from ..import_directions import wrong_imports


def test_imports_point_one_way() -> None:
    assert wrong_imports() == []


def test_the_guard_sees_an_import_that_points_the_wrong_way(tmp_path: Path) -> None:
    for folder, text in (
        ("firmware_protocol/taxeld_protocol", "import taxeld.config\n"),
        ("daemon/taxeld", "def f():\n    import torch\n"),
        ("hil/taxeld_hil", "from taxeld_training import build\n"),
    ):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "bad.py").write_text(text, encoding="utf-8")
    assert [line.split(": ")[1] for line in wrong_imports(tmp_path)] == [
        "imports taxeld", "imports torch", "imports taxeld_training",
    ]  # fmt: skip


ROOT = Path(__file__).parents[2]


def test_the_readmes_sampler_table_is_what_the_bundles_say() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for name in ("box", "mug"):
        info = json.loads((bundle.find(name) / "bundle.json").read_text(encoding="utf-8"))
        known = {s["name"]: s for s in info["samplers"]} | info["analytic"]
        shown = ("projection", "table", "ddpm-100", "density-16", "density-64")
        figures = [*(known[name]["energy_distance"] for name in shown), info["energy_floor"]]
        assert f"| `{name}` | " + " | ".join(f"{f:.3f}" for f in figures) + " |" in text


def test_the_example_configuration_is_fine() -> None:
    assert config.load(ROOT / "examples" / "can0.toml").source.channel == "can0"
