"""The guard of the rooms: who may import whom, which rooms are pure, and how much one may import.

A room is a folder of a package, or a module beside them. Imports are read from the syntax tree, so
those inside functions count as well. `make lint` and tests/system/test_house.py run this.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
FOLDERS = {  # package → its source root
    "taxeld_protocol": "firmware_protocol",
    "taxeld": "daemon",
    "taxeld_training": "training",
    "taxeld_hil": "hil",
    "taxeld_ros2": "ros2",
}
PACKAGES = {  # what a package may import, beside itself
    "taxeld_protocol": "",
    "taxeld": "taxeld_protocol",
    "taxeld_training": "taxeld_protocol taxeld torch",
    "taxeld_hil": "taxeld_protocol taxeld",
    "taxeld_ros2": "taxeld",
}
ROOMS = {  # what a room may import of its package, beside itself and what stands in EVERYWHERE
    "taxeld": {
        "config": "",
        "layout": "config",
        "model": "layout",
        "skin": "config layout model",
        "proposals": "config layout model",
        "estimator": "config model",
        "source": "config layout",
        "pipeline": "config layout model skin proposals estimator",
        "stream": "config layout model skin proposals estimator pipeline",
        "service": "config layout model skin proposals estimator source pipeline stream",
        "commands": "config layout model skin proposals estimator source pipeline stream service",
        "api": "config layout model skin proposals estimator source pipeline stream service "
        "commands",
        "command_line": "config",
        "view": "config layout model skin proposals estimator source pipeline stream service "
        "commands command_line",
        "cli": "config layout model skin proposals estimator source pipeline stream service "
        "commands command_line view",
    },
    "taxeld_hil": {
        "scenario": "",
        "world": "scenario",
        "rig": "scenario world",
        "grade": "scenario world rig",
        "run": "scenario world rig grade",
        "acceptance": "",
        "experiment": "scenario world rig grade run",
        "cli": "scenario world rig grade run acceptance experiment",
    },
    "taxeld_training": {
        "objects": "",
        "models": "",
        "jobs": "",
        "limits": "models jobs",
        "charts": "jobs",
        "samplers": "objects models limits jobs charts",
        "filters": "objects models limits jobs charts samplers",
        "bundles": "",
        "build": "objects samplers bundles",
        "cli": "objects models limits jobs samplers filters bundles build",
    },
}
EVERYWHERE = {"", "arrays", "errors", "native"}  # a package itself, and these of its modules
PURE = {
    "taxeld.config.tables",
    "taxeld.model",
    "taxeld.skin",
    "taxeld.estimator",
    "taxeld.pipeline",
}
IMPURE = {
    *("time", "os", "socket", "threading", "pathlib", "json", "zipfile"),
    *("zmq", "can", "serial", "onnxruntime"),
}
INSTALLED = {"taxeld.native"}  # what it finds depends on the installation alone
MOST = 12  # modules of the project that one module may import
UNBOUNDED = ("service", "api", "cli")  # rooms that put everything together


class Import(NamedTuple):
    """A module that another imports, and in which line."""

    name: str
    line: int


class House:
    """The modules of all packages below `root`, and what each imports."""

    def __init__(self, root: Path = ROOT) -> None:
        self._root = root
        self._paths: dict[str, Path] = {}
        for package, folder in FOLDERS.items():
            for path in sorted((root / folder / package).rglob("*.py")):
                parts = path.relative_to(root / folder).with_suffix("").parts
                self._paths[".".join(p for p in parts if p != "__init__")] = path
        self._imports = {module: dict.fromkeys(self._read(module)) for module in self._paths}

    def faults(self) -> list[str]:
        """One line a fault."""
        return [*self._wrong_packages(), *self._wrong_rooms(), *self._impure(), *self._too_many()]

    def _read(self, module: str) -> Iterator[Import]:
        for node in ast.walk(ast.parse(self._paths[module].read_text(encoding="utf-8"))):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{module}: a relative import"
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (Import(self._known(name), node.lineno) for name in names)  # type: ignore[attr-defined]

    def _known(self, name: str) -> str:
        """The project's module that the name is, or is from; of other packages, the first part."""
        while name not in self._paths and "." in name:
            name = name.rpartition(".")[0]
        return name

    def _at(self, module: str, line: int = 1) -> str:
        return f"{self._paths[module].relative_to(self._root)}:{line}"

    def _wrong_packages(self) -> Iterator[str]:
        for module, imports in self._imports.items():
            package = module.split(".")[0]
            for name, line in imports:
                other = name.split(".")[0]
                known = other in {*PACKAGES, "torch"}
                if known and other not in {package, *PACKAGES[package].split()}:
                    yield f"{self._at(module, line)}: {package} may not import {other}"

    def _wrong_rooms(self) -> Iterator[str]:
        for module, imports in self._imports.items():
            package, room = _room(module)
            rooms = ROOMS.get(package, {})
            if rooms and room not in {*rooms, *EVERYWHERE}:
                yield f"{self._at(module)}: room {room} of {package} is not in the table"
                continue
            allowed = {room, *EVERYWHERE, *rooms.get(room, "").split()}
            for name, line in imports:
                where, other = _room(name)
                if rooms and where == package and other not in allowed:
                    yield f"{self._at(module, line)}: room {room} may not import room {other}"

    def _impure(self) -> Iterator[str]:
        for module in self._paths:
            if module in PURE or ".".join(module.split(".")[:2]) in PURE:
                way = self._way_out(module)
                if way:
                    yield f"{self._at(module)}: must be pure, but imports {' → '.join(way)}"

    def _way_out(self, start: str) -> list[str]:
        """The shortest chain of imports from a module to one of IMPURE; packages import as well."""
        ways = [[start]]
        seen = {start}
        for way in ways:
            parts = way[-1].split(".")
            packages = [".".join(parts[:k]) for k in range(1, len(parts))]
            for name in [*packages, *(found.name for found in self._imports.get(way[-1], ()))]:
                if name in IMPURE:
                    return [*way[1:], name]
                if name in self._paths and name not in seen | INSTALLED:
                    seen.add(name)
                    ways.append([*way, name])
        return []

    def _too_many(self) -> Iterator[str]:
        for module, imports in self._imports.items():
            own = {name for name, _ in imports if name in self._paths}
            if len(own) > MOST and _room(module)[1] not in UNBOUNDED:
                yield f"{self._at(module)}: imports {len(own)} modules of the project, not {MOST}"


def _room(module: str) -> tuple[str, str]:
    """The package of a module, and its room: a folder, or a module beside the folders."""
    package, _, rest = module.partition(".")
    return package, rest.split(".")[0]


if __name__ == "__main__":
    found = House().faults()
    print("\n".join(found))  # noqa: T201
    sys.exit(bool(found))
