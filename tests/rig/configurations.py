"""Configurations of daemons."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from taxeld.config.file import parse
from taxeld.config.tables import Config

QUIET = {"kind": "can", "interface": "virtual", "channel": "quiet"}  # a bus where nobody speaks
Table = Mapping[str, Any]


def toml(**tables: Table) -> str:
    """Tables by name; a path is a text."""
    return "".join(
        f"[{name}]\n" + "".join(f"{k} = {json.dumps(v, default=str)}\n" for k, v in keys.items())
        for name, keys in tables.items()
    )


def served(place: Path) -> dict[str, Table]:
    """The tables of a daemon that serves in `place`."""
    stream, control = f"ipc://{place}/stream", f"ipc://{place}/control"
    return {"publish": {"endpoints": [stream]}, "control": {"endpoint": control}}


def config(**tables: Table) -> Config:
    """A configuration of a box, and a CAN bus where `source` is not given."""
    whole = {"source": {"kind": "can", "channel": "can0"}, "scene": {"bundle": "box"}} | tables
    return parse(toml(**whole))


def configuration(place: Path, **tables: Table) -> Path:
    """The file of a daemon on a quiet bus that serves in `place`; `tables` take the place of its
    own."""
    whole = {"source": QUIET, "scene": {"bundle": "box"}}
    path = place / "config.toml"
    path.write_text(toml(**whole | served(place) | tables), encoding="utf-8")
    return path
