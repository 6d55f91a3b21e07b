"""`taxeld init`: a configuration with every key explained, from options."""

import json
import os
from collections.abc import Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any, get_type_hints

from taxeld.config import endpoints, gate
from taxeld.config import file as config_file
from taxeld.config.tables import Config, SkinConfig, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import generated
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld.source.sources import least_period_ms

Tables = dict[str, dict[str, Any]]  # values of keys, by table

FORMS = (
    "can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0, array:ENDPOINT, or an interface of "
    "python-can's and its channel, as pcan:PCAN_USBBUS1"
)


def write(path: Path, options: Mapping[str, Any]) -> Config:
    """Write the configuration that follows from the options of the command.

    Raises:
        SetupError: an option is missing or cannot be used, or the file exists already.
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
    """The keys that follow from the options."""
    source, named = connection(options["source"], "--source"), options["bundle"]
    usual, built = SkinConfig(), bundle.manifest_of(named) if named else None
    layout = options["layout"] or (built.layout.name if built else usual.layout)
    if not options["layout"] and ":" not in layout:
        raise SetupError(f"--layout: name the file of {layout}, for which {named} was built")
    placed = layouts.load(layout)
    skin: dict[str, Any] = {"layout": layout if generated.parse(layout) else _from(path, layout)}
    if built and built.depth_max_m != usual.full_scale_depth_m:
        skin["full_scale_depth_m"] = built.depth_max_m
    planned = SourceConfig(**source)
    least_ms = 0 if planned.kind == "array" else least_period_ms(planned, placed)
    if least_ms > planned.period_ms:
        source["period_ms"] = least_ms
    return {
        "scene": {"bundle": _from(path, named)} if named else {},
        "source": source,
        "skin": skin,
        "sensor_pose": {"endpoint": options["poses"]} if options["poses"] else {},
    }


def connection(text: str, option: str) -> dict[str, Any]:
    """The keys of [source] for what FORMS names; `option`: of the command, for a fault.

    Raises:
        SetupError: the text is none of them.
    """
    kind, _, channel = text.partition(":")
    if not kind or not channel:
        raise SetupError(f"{option}: '{text}' is no connection; use {FORMS}")
    if kind == "array":
        if fault := endpoints.fault(channel):
            raise SetupError(f"{option}: {fault}")
        return {"kind": kind, "endpoint": channel}
    if kind in ("can", "serial"):
        return {"kind": kind, "channel": channel}
    return {"kind": "can", "interface": kind, "channel": channel}


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
