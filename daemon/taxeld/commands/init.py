"""`taxeld init`: a configuration with every key explained, from answers or options."""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

from taxeld.config import file as config_file
from taxeld.config.tables import Config
from taxeld.config.toml_tables import ConfigError
from taxeld.errors import SetupError
from taxeld.layout import generated
from taxeld.proposals import bundle, manifest

SOURCES = {  # connection as named by `taxeld-hil accept` → keys of [source]
    "can": {"kind": "can"},
    "slcan": {"kind": "can", "interface": "slcan"},
    "serial": {"kind": "serial"},
}
FORMS = "can:can0, slcan:/dev/ttyACM0 or serial:/dev/ttyACM0"
Ask = Callable[[str], str]


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers to the questions; None: not asked yet."""

    source: str | None = None
    bundle: str | None = None
    layout: str | None = None
    poses: str | None = None
    dialect: str = "cyskin"
    keys: str = ""


def write(path: Path, answers: Answers, ask: Ask | None) -> Config:
    """Write the configuration; `ask` puts a question to a person, None where there is none.

    Raises:
        SetupError: an answer is missing or cannot be used, or the file exists already.
    """
    if os.path.lexists(path):
        raise SetupError(f"{path}: is there already and is not overwritten; name another file")
    text = lines(path, _given(path, answers, ask))
    config = config_file.parse(text, str(path))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise SetupError(f"{path}: cannot be written ({error.strerror})") from None
    return config


def person() -> Ask | None:
    """A way to ask a person at a terminal; None where there is none."""
    return _typed if sys.stdin.isatty() and sys.stderr.isatty() else None


def lines(path: Path, given: dict[str, dict[str, Any]]) -> str:
    """The text: `given` keys by their tables, and all others as comments."""
    text = [
        "# Configuration of a taxeld daemon. A key behind a '#' has its default.",
        f"# Test it with 'taxeld check {path.name}', run it with 'taxeld run {path.name}'.",
    ]
    for table in fields(Config):
        text += ["", f"[{table.name}]"]
        set_here = given.get(table.name, {})
        for key in fields(get_type_hints(Config)[table.name]):
            text += _key(key, set_here)
    return "\n".join(text) + "\n"


def _key(key: Field[Any], given: dict[str, Any]) -> list[str]:
    about = f"# {key.metadata['doc']}"
    if key.name in given:
        return [about, f"{key.name} = {toml(given[key.name])}"]
    default = '""' if key.default is MISSING else toml(key.default)
    return [about, f"#{key.name} = {default}"]


def toml(value: object) -> str:
    """A key's value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)


def _given(path: Path, answers: Answers, ask: Ask | None) -> dict[str, dict[str, Any]]:
    """The keys that follow from the answers, by their tables."""

    def answer(given: str | None, option: str, question: str, default: str | None) -> str:
        if given is not None:
            return given
        if ask is not None:
            shown = f" [{default}]" if default else ""
            return ask(f"{question}{shown}: ").strip() or default or ""
        if default is None:
            raise SetupError(f"{option}: is required where nobody can be asked; {question}")
        return default

    source = _source(answer(answers.source, "--source", f"the skin's connection, {FORMS}", None))
    named = answer(
        answers.bundle, "--bundle", "the object: box, mug, or the directory of a bundle", None
    )
    its_own = _layout_of(named)  # also refuses a directory that is no bundle
    layout = answers.layout or its_own
    if layout is None:
        layout = answer(None, "--layout", "the skin's layout, as the bundle was built for", None)
    poses = answer(
        answers.poses, "--poses",
        "where the robot publishes the sensor's pose, tcp://HOST:PORT; empty if the sensor stands "
        "still", "",
    )  # fmt: skip
    given: dict[str, dict[str, Any]] = {
        "scene": {"bundle": _from(path, named)},
        "source": source | ({"dialect": answers.dialect} if answers.dialect != "cyskin" else {}),
        "skin": {"layout": layout if generated.parse(layout) else _from(path, layout)},
    }
    if answers.dialect == "icub":
        given["skin"]["full_scale_counts"] = 200.0
    if poses:
        given["sensor_pose"] = {"endpoint": poses}
    if answers.keys:
        given["curve"] = {"directory": str(Path(answers.keys).absolute())}
    return given


def _source(text: str) -> dict[str, Any]:
    kind, _, channel = text.partition(":")
    if kind not in SOURCES or not channel:
        raise SetupError(f"--source: '{text}' is no connection; use {FORMS}")
    return {**SOURCES[kind], "channel": channel}


def _layout_of(name: str) -> str | None:
    """The generated layout that a bundle was built for; None where it came from a file."""
    found = bundle.find(name) / manifest.NAME
    spec = manifest.parse(manifest.read(found), found)[0].layout.name
    return spec if ":" in spec else None


def _from(path: Path, name: str) -> str:
    """The name of a file or directory relative to the configuration; of a shipped bundle, its
    name."""
    there = Path(name)
    if bundle.is_shipped(name) or not os.path.exists(there):  # noqa: PTH110  (False of any text)
        return name
    there = there.parent.resolve() / there.name  # a link keeps its own name
    beside = path.parent.resolve()
    return str(there.relative_to(beside) if there.is_relative_to(beside) else there)


def _typed(question: str) -> str:
    """Raises ConfigError at the end of input."""
    print(question, end="", file=sys.stderr, flush=True)  # noqa: T201  (standard output is the answer)
    line = sys.stdin.readline()
    if not line:
        raise ConfigError(["taxeld init: the questions were not answered; nothing is written"])
    return line
