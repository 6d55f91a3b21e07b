"""Configuration: every fault is named by its path, and the documentation is the code's."""

import json
import os
from dataclasses import MISSING, fields
from pathlib import Path
from typing import get_type_hints

import pytest

from taxeld.config.file import load, parse
from taxeld.config.gone import GONE
from taxeld.config.tables import Config
from taxeld.config.toml_tables import ConfigError

MINIMAL = '[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n'
DOCUMENTED = Path(__file__).parents[2] / "examples" / "defaults.toml"


def test_a_minimal_configuration_has_every_default() -> None:
    config = parse(MINIMAL)
    assert config.source.interface == "socketcan"
    assert config.filter.particles == 100
    assert config.publish.endpoints == ("ipc:///run/taxeld/stream",)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("[source]\nchanel = 'x'", "source.chanel: unknown key; did you mean channel?"),
        ("[speed]\na = 1", "speed: unknown key"),
        (
            "[source]\nkind = 'usb'",
            "source.kind: must be one of can, serial, array, not 'usb'",
        ),
        ("[source]\nkind = 7", "source.kind: must be a string, not 7"),
        ("[source]\nkind = 'serial'", "source.channel: is required for kind 'serial'"),
        ("[loop]\nrate_hz = 0", "loop.rate_hz: must be 1..1000, not 0"),
        ("[loop]\nrate_hz = nan", "loop.rate_hz: must be a number, not nan"),
        ("[log]\nlevel = 'loud'", "log.level: must be one of debug, info, warning, error"),
        ("[filter]\nparticles = 1.5", "filter.particles: must be an integer, not 1.5"),
        ("[filter]\ncentre_m = [1]", "filter.centre_m: must be a list of 2 (float), not [1]"),
        ("[filter]\nwithin_m = 10", "filter.within_m: must be 0.001..0.1, not 10"),
        ("loop = 3", "loop: must be a table [loop]"),
        ("[source]\nmodules = [7]", "source.modules: must be a list (a list (int)), not [7]"),
        (
            "[source]\nmodules = [[7]]",
            "source.modules: [7]: must be [SUI, mask] or [SUI, mask, hub]",
        ),
        ("[source]\nmodules = [[7, 0x1000]]", "source.modules: [7, 4096]: 0x1000 is no mask"),
        ("[source]\nmodules = [[-1, 1]]", "source.modules: [-1, 1]: -1 is no serial number"),
        ("[source]\nmodules = [[7, 1, 255]]", "source.modules: [7, 1, 255]: 255 is no short id"),
        ("[source]\nmodules = [[7, 1], [7, 3]]", "source.modules: lists module 7 more than once"),
        ("[source]\nmodules = [[7, 1], [8, 1, 1]]", "source.modules: must name the hub of every"),
        ("[relay]\npublish = ['tcp://0.0.0.0:1']", "relay.publish: 'tcp://0.0.0.0:1' is not local"),
        ("[relay]\ncontrol = 'tcp://*:1'", "relay.control: 'tcp://*:1' is not local"),
        ("", "source: is required"),
        (
            f"[loop]\nrate_hz = {'9' * 400}",
            "loop.rate_hz: must be a number, not so large an integer",
        ),
        (f"[loop]\nrate_hz = 1{'0' * 400}.0", "loop.rate_hz: must be a number, not inf"),
        (f"[filter]\nseed = 0x{'f' * 9999}", "filter.seed: must be an integer, not so large"),
        (
            f"[filter]\ncentre_m = [0, {'9' * 400}]",
            "filter.centre_m: must be a list of 2 (float), no",
        ),
        ('[loop]\n"a\\nb" = 1', "loop.a?b: unknown key"),
        (
            '[log]\nlevel = "lo\\nud"',
            "log.level: must be one of debug, info, warning, error, not 'lo\\nud'",
        ),
    ],
)
def test_each_fault_is_one_line_that_names_its_path(change: str, fault: str) -> None:
    text = change if "source" in change else change + "\n"
    if fault.split(":", maxsplit=1)[0] != "source":
        text += MINIMAL if "[source]" not in change else '\n[scene]\nbundle = "box"\n'
    elif change:
        text += '[source]\nkind = "can"\nchannel = "can0"\n'
    with pytest.raises(ConfigError) as error:
        parse(text)
    assert any(line.startswith(fault) for line in error.value.faults), error.value.faults
    assert all(line.isprintable() and len(line) < 1100 for line in error.value.faults)


@pytest.mark.parametrize("name", [name for name in GONE if not name.startswith(("-", "taxeld"))])
def test_a_key_that_is_gone_is_refused_with_what_replaces_it(name: str) -> None:
    table, _, key = name.partition(".")
    line = key if "=" in key else f"{key or 'key'} = 1"
    own = "".join(f"{row}\n" for row in MINIMAL.splitlines() if row.split()[0] != line.split()[0])
    text = own.replace(f"[{table}]\n", f"[{table}]\n{line}\n")
    text += "" if f"[{table}]" in text else f"[{table}]\n{line}\n"
    with pytest.raises(ConfigError) as error:
        parse(text)
    assert error.value.faults == [f"{name}: is gone; {GONE[name]}"]


def test_all_faults_are_found_at_once() -> None:
    with pytest.raises(ConfigError) as error:
        parse(MINIMAL + "[loop]\nrate_hz = -1\nspeed = 2\n[filter]\nseed = 'x'\n")
    assert len(error.value.faults) == 3


@pytest.mark.parametrize(
    "text",
    [
        *("a = ", "a = " + "[" * 100_000, f"a = {'9' * 5000}", "a = '\0'", "a = 2026-13-01"),
        *(f"{'a.' * 30_000}a = 1", f"[{'a.' * 30_000}a]"),
    ],
)
def test_what_is_not_toml_is_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^x\.toml: (not TOML: |line 1: a key of more)[^\n]+$"):
        parse(text, "x.toml")


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"\xff\xfe", "'utf-8' codec can't decode"),
        (b"#" * 70_000, "is larger than 64000 bytes"),
        (None, "is no regular file"),
    ],
    ids=["no text", "too large", "a pipe"],
)
def test_a_file_that_is_no_configuration_is_one_line(
    tmp_path: Path, content: bytes | None, fault: str
) -> None:
    path = tmp_path / "taxeld.toml"
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=f"^[^\n]+taxeld.toml: unreadable.*{fault}[^\n]*$"):
        load(path)


def test_the_documented_keys_are_the_codes() -> None:
    lines = []
    for table in fields(Config):
        if "tables" in table.metadata:  # several of another table: docs/links.md
            continue
        lines += ["", f"[{table.name}]"]
        for key in fields(get_type_hints(Config)[table.name]):
            default = '"can"' if key.default is MISSING else json.dumps(key.default)
            lines.append(f"{key.name} = {default} # {key.metadata['doc']}")
    documented = DOCUMENTED.read_text(encoding="utf-8").splitlines()
    assert [" ".join(line.split()) for line in documented[1:]] == lines


def test_a_bundle_and_a_layout_are_named_as_seen_from_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, shell = tmp_path / "robot", tmp_path / "shell"
    for directory in (place / "bracket", place / "box", shell / "handle"):
        directory.mkdir(parents=True)
    (place / "skin.json").touch()
    monkeypatch.chdir(shell)
    path = place / "skin.toml"

    def named(bundle: str, layout: str) -> tuple[str, str]:
        text = MINIMAL.replace('"box"', f'"{bundle}"') + f'[skin]\nlayout = "{layout}"\n'
        path.write_text(text, encoding="utf-8")
        config = load(path)
        return config.scene.bundle, config.skin.layout

    cylinder = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
    assert named("bracket", "skin.json") == (str(place / "bracket"), str(place / "skin.json"))
    assert named("handle", cylinder) == ("handle", cylinder), "in the shell's directory"
    assert named("box", cylinder) == ("box", cylinder), "the shipped one"
    assert named("x\\u0000y", cylinder)[0] == "x\0y"
