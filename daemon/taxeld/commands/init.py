"""`taxeld init`: a configuration with every key explained, from options; questions ask the rest."""

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any, get_type_hints

from taxeld.config import file as config_file
from taxeld.config import gate
from taxeld.config.gate import ConfigError
from taxeld.config.tables import Config, SkinConfig, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import generated
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld.source.sources import least_period_ms

Tables = dict[str, dict[str, Any]]  # values of keys, by table

SOURCES = {  # connection as named by `taxeld-hil accept` → keys of [source]
    "can": {"kind": "can"},
    "slcan": {"kind": "can", "interface": "slcan"},
    "serial": {"kind": "serial"},
    "array": {"kind": "array"},
}
FORMS = "can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0 or array:ENDPOINT"
QUESTIONS = {  # by option
    "source": f"the skin's connection, {FORMS}",
    "bundle": "the object: box, drill, mug, or the directory of a bundle; empty for the skin alone",
    "layout": "the skin's layout, as the bundle was built for",
    "poses": "where the robot publishes the sensor's pose, tcp://HOST:PORT; empty if the sensor "
    "stands still",
    "where": "where the object can be in the world: X Y HALF, the middle of a square and half its "
    "width in metres; empty for 0 0 0.5",
}
OPTIONAL = ("poses", "where")  # these may stay without an answer


def write(path: Path, options: Mapping[str, Any]) -> Config:
    """Write the configuration of the options of `QUESTIONS`; a person at the terminal is asked for
    those that are None.

    Raises:
        SetupError: an answer is missing or cannot be used, or the file exists already.
    """
    if os.path.lexists(path):
        raise SetupError(f"{path}: is there already and is not overwritten; name another file")
    text = _text(path, _tables(path, options))
    config = config_file.parse(text, str(path))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise SetupError(f"{path}: cannot be written ({error.strerror})") from None
    return config


def _text(path: Path, given: Tables) -> str:
    """The file: `given` keys, and all others as comments."""
    text = [
        "# Configuration of a taxeld daemon. A key behind a '#' has its default.",
        f"# Test it with 'taxeld check {path.name}', run it with 'taxeld run {path.name}'.",
        "# The link that carries the skin must stand upright, its axis within 0.1 rad of vertical;",
        "# a daemon cannot notice that it is tilted.",
    ]
    for table in gate.keys_of(Config):
        text += ["", f"[{table.name}]"]
        values = given.get(table.name, {})
        for key in gate.keys_of(get_type_hints(Config)[table.name]):
            default = "" if key.default is MISSING else key.default
            mark = "" if key.name in values else "#"
            text.append(f"# {key.metadata['doc']}")
            text.append(f"{mark}{key.name} = {_toml(values.get(key.name, default))}")
    return "\n".join(text) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)


def _tables(path: Path, options: Mapping[str, Any]) -> Tables:
    """The keys that follow from the options and the answers."""
    source = _source(_answer(options, "source"))
    named = _answer(options, "bundle")
    depth_m, own = SkinConfig().full_scale_depth_m, ""
    if named:
        built = bundle.manifest_of(named)  # refuses a directory that is no bundle
        depth_m = built.depth_max_m
        own = built.layout.name if ":" in built.layout.name else ""  # a file's name finds no file
    layout = options["layout"] or own or _answer(options, "layout")
    placed = layouts.load(layout)
    poses = _answer(options, "poses")
    skin: dict[str, Any] = {"layout": layout if generated.parse(layout) else _from(path, layout)}
    if depth_m != SkinConfig().full_scale_depth_m:
        skin["full_scale_depth_m"] = depth_m
    planned = SourceConfig(**source)
    least_ms = 0 if planned.kind == "array" else least_period_ms(planned, placed)
    if least_ms > planned.period_ms:
        source["period_ms"] = least_ms
    return {
        "scene": {"bundle": _from(path, named)} if named else {},
        "source": source,
        "skin": skin,
        "sensor_pose": {"endpoint": poses} if poses else {},
        "filter": _square(_answer(options, "where")) if named else {},
    }


def _answer(options: Mapping[str, Any], option: str) -> str:
    """An option's value, or the answer of a person at the terminal."""
    if (given := options[option]) is not None:
        return given if isinstance(given, str) else " ".join(given)
    question = QUESTIONS[option]
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        if option in OPTIONAL:
            return ""
        raise SetupError(f"--{option}: is required where nobody can be asked; {question}")
    sys.stderr.write(f"{question}: ")
    sys.stderr.flush()
    line = sys.stdin.readline()
    if not line:
        raise ConfigError(["taxeld init: the questions were not answered; nothing is written"])
    return line.strip()


def _square(text: str) -> dict[str, Any]:
    if not text:
        return {}
    try:
        x, y, half = map(float, text.replace(",", " ").split())
    except ValueError:
        raise SetupError(f"--where: '{text}' is no X Y HALF in metres, as 0.8 0 0.4") from None
    return {"centre_m": (x, y), "half_width_m": half}


def _source(text: str) -> dict[str, Any]:
    kind, _, channel = text.partition(":")
    if kind not in SOURCES or not channel:
        raise SetupError(f"--source: '{text}' is no connection; use {FORMS}")
    return {**SOURCES[kind], "endpoint" if kind == "array" else "channel": channel}


def _from(path: Path, name: str) -> str:
    """The name of a file or directory relative to the configuration; of a shipped bundle, its
    name."""
    there = Path(name)
    if name in bundle.shipped() or not os.path.exists(there):  # noqa: PTH110  (False of any text)
        return name
    there = there.parent.resolve() / there.name  # a link keeps its own name
    beside = path.parent.resolve()
    near = str(there.relative_to(beside) if there.is_relative_to(beside) else there)
    return str(there) if near in bundle.shipped() else near  # of a directory that is called box
