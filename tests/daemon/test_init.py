"""`taxeld init`: what it writes is complete, and is what `taxeld check` takes."""

import os
import re
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import get_type_hints

import pytest

from taxeld.config.file import load, parse
from taxeld.config.gate import keys_of
from taxeld.config.tables import Config, SkinConfig
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld.source.sources import live
from tests.rig.commands import printed, refused

FLAGS = ["--source", "slcan:{device}", "--bundle", "box", "--poses", "tcp://127.0.0.1:9874"]


@pytest.fixture
def flags(tmp_path: Path) -> Iterator[list[str]]:
    ours, theirs = os.openpty()
    (tmp_path / "ttyACM0").symlink_to(os.ttyname(theirs))
    yield [flag.format(device=tmp_path / "ttyACM0") for flag in FLAGS]
    os.close(ours)
    os.close(theirs)


def test_what_is_written_from_options_is_fine(
    tmp_path: Path, flags: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "skin.toml"
    assert printed("init", path, *flags).endswith(f"; next: taxeld check {path}\n")
    assert printed("check", path).startswith(f"{path}: fine")
    assert "must stand upright, its axis within 0.1 rad of vertical" in path.read_text()
    config = parse(path.read_text(encoding="utf-8"))
    assert (config.source.kind, config.source.interface) == ("can", "slcan")
    assert config.source.channel == str(tmp_path / "ttyACM0")
    assert config.sensor_pose.endpoint == "tcp://127.0.0.1:9874"


def test_an_array_and_a_skin_without_an_object_have_a_configuration(tmp_path: Path) -> None:
    array, alone = tmp_path / "array.toml", tmp_path / "alone.toml"
    printed("init", array, *FLAGS[2:4], "--source", "array:ipc:///skin", "--poses", "")
    source = load(array).source
    assert (source.kind, source.endpoint) == ("array", "ipc:///skin")
    layout = SkinConfig().layout
    printed("init", alone, "--source", "can:can0", "--layout", layout)
    assert (load(alone).scene.names, load(alone).skin.layout) == ((), layout)


def test_a_skin_too_large_for_the_usual_period_gets_one_that_the_bus_carries(
    tmp_path: Path, flags: list[str]
) -> None:
    path = tmp_path / "large.toml"
    large = "cylinder:rows=31,columns=80,radius_m=0.2,pitch_m=0.015"
    printed("init", path, *flags, "--layout", large)
    config = parse(path.read_text(encoding="utf-8"))
    assert config.source.period_ms == 83
    live(config.source, layouts.load(large))


def test_the_depth_is_that_of_the_bundle(tmp_path: Path) -> None:
    box = Path(shutil.copytree(bundle.find("box"), tmp_path / "box")) / "bundle.json"
    box.write_text(re.sub(r'"depth_max_m": [0-9.]+', '"depth_max_m": 0.003', box.read_text()))
    written = tmp_path / "skin.toml"
    printed("init", written, "--source", "can:can0", "--bundle", box.parent)
    config = load(written)
    assert config.skin.full_scale_depth_m == 0.003
    loaded = bundle.load(config.scene.bundle, layouts.load(config.skin.layout), 0.003)
    assert loaded.model.depth_max_m == 0.003


def test_each_key_is_there_with_the_documented_words_and_its_default(
    tmp_path: Path, flags: list[str]
) -> None:
    path = tmp_path / "skin.toml"
    printed("init", path, *flags)
    text = path.read_text(encoding="utf-8")
    tables = keys_of(Config)
    for table in tables:
        for key in keys_of(get_type_hints(Config)[table.name]):
            assert f"# {key.metadata['doc']}\n" in text, (table.name, key.name)
    bare = "\n".join(
        line.removeprefix("#") if line.startswith("#") and line[1:2] != " " else line
        for line in text.splitlines()
    )
    written = replace(parse(bare), is_sized=False)  # a written number of particles holds
    assert asdict(written) == asdict(parse(text)), "a default that is written is the code's"
    assert set(tomllib.loads(bare)) == {table.name for table in tables}


def test_a_file_that_is_there_is_not_overwritten(tmp_path: Path, flags: list[str]) -> None:
    path = tmp_path / "skin.toml"
    path.write_text("mine", encoding="utf-8")
    assert refused("init", path, *flags).startswith(
        f"{path}: is there already and is not overwritten"
    )
    assert path.read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (["--source", "usb0"], "--source: 'usb0' is no connection; use can:can0, slcan:"),
        (["--bundle", "n" * 5000], "scene.bundle: no bundle 'nnnn"),
        (["--layout", "cylinder:rowz=5"], "skin.layout: cylinder: rowz: unknown key; did you"),
        (["--source", ""], "--source: '' is no connection; use can:can0, slcan:"),
        (["--poses", "tcp://robot:1"], "sensor_pose.endpoint: 'tcp://robot:1' is not local"),
    ],
)
def test_an_option_that_cannot_be_used_is_one_line_and_nothing_is_written(
    tmp_path: Path, flags: list[str], change: list[str], line: str
) -> None:
    path = tmp_path / "skin.toml"
    assert refused("init", path, *flags, *change).startswith(line)
    assert not path.exists()


def test_the_layout_of_a_bundle_that_was_built_for_a_file_is_to_be_named(
    tmp_path: Path, flags: list[str]
) -> None:
    box = Path(shutil.copytree(bundle.find("box"), tmp_path / "box")) / "bundle.json"
    box.write_text(re.sub(r'"name": "cylinder:[^"]*"', '"name": "patch"', box.read_text()))
    line = refused("init", tmp_path / "skin.toml", *flags, "--bundle", box.parent)
    assert line.startswith("--layout: name the file of patch, for which ")


def test_a_bundle_is_named_as_seen_from_the_configuration(
    tmp_path: Path, flags: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bracket").symlink_to(bundle.find("box"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    printed("init", "../skin.toml", *flags, "--bundle", tmp_path / "bracket")
    assert '\nbundle = "bracket"\n' in (tmp_path / "skin.toml").read_text(encoding="utf-8")
