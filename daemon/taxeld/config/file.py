"""The configuration file: reading, and checks across keys."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from taxeld import files
from taxeld.config import endpoints, links, toml_tables
from taxeld.config.tables import SIZES, Config, SourceConfig
from taxeld.config.toml_tables import ConfigError

CONFIG_BYTES = 64_000  # ten times the length of a file from `taxeld init`, with all comments
TOML_BYTES = 1_000_000  # limit for any other TOML file; a calibration has a line for each taxel
SHIPPED = Path(__file__).parents[1] / "bundles"


def load(path: Path) -> Config:
    """Read and validate a configuration file.

    Raises:
        ConfigError: all faults at once.
    """
    config = _for_this_user(parse(text_of(path, CONFIG_BYTES), str(path)))
    skin, scene = config.skin, config.scene
    if skin.calibration:
        # an absolute path stays unchanged
        skin = replace(skin, calibration=str(path.parent / skin.calibration))
    skin = replace(skin, layout=_beside(path, skin.layout))
    further = tuple(
        replace(
            link,
            layout=_beside(path, link.layout),
            calibration=str(path.parent / link.calibration) if link.calibration else "",
        )
        for link in config.links
    )
    several = tuple(_beside(path, name, SHIPPED) for name in scene.bundles)
    scene = replace(scene, bundle=_beside(path, scene.bundle, SHIPPED), bundles=several)
    return replace(config, skin=skin, scene=scene, links=further)


def text_of(path: Path, most: int = TOML_BYTES) -> str:
    """The text of a TOML file of at most `most` bytes.

    Raises:
        ConfigError: it is unreadable, or too large.
    """
    try:
        return files.read(path, most).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError([f"{path}: unreadable configuration ({error})"]) from None
    except OSError as error:
        reason = f"{path}: unreadable configuration ({error.strerror}); name a configuration"
        raise ConfigError([reason]) from None


def parse(text: str, name: str = "configuration") -> Config:
    """Validate configuration text.

    Raises:
        ConfigError: all faults at once.
    """
    config = links.completed(toml_tables.parse(Config, text, name))
    given = toml_tables.loads(text).get("filter", {})
    config = replace(config, is_sized=not given.keys().isdisjoint(SIZES))
    faults: list[str] = links.faults(config)
    _check_source(config.source, faults)
    _check_scene(config, faults)
    _check_endpoints(config, faults)
    if faults:
        raise ConfigError(faults)
    return config


def _beside(path: Path, name: str, shipped: Path | None = None) -> str:
    """A name in the configuration at `path`, resolved from that file's directory unless it is
    `shipped`; else from the shell's directory, because a session keeps its configuration without
    the bundle."""
    try:
        if shipped is not None and (shipped / name).is_dir():
            return name
        return str(path.parent / name) if (path.parent / name).exists() else name
    except (OSError, ValueError):  # not a path, or not readable by this user
        return name


def _check_source(source: SourceConfig, faults: list[str]) -> None:
    if source.kind in ("can", "serial") and not source.channel:
        faults.append(f"source.channel: is required for kind '{source.kind}'")
    if source.kind == "array":
        fault = endpoints.array_fault(source.endpoint)
        if fault:
            faults.append(f"source.endpoint: {fault}")


def _check_scene(config: Config, faults: list[str]) -> None:
    scene, learned = config.scene, config.filter
    if not scene.names:
        faults += [
            f"{key}: needs an object: name it in scene.bundle, or leave this out"
            for key in _of_objects(config)
        ]
        return
    if scene.bundle and scene.bundles:
        faults.append("scene.bundles: is given beside scene.bundle; keep one of the two")
    if len(scene.names) == 1:
        return
    cure = "name one scene.bundle"
    if learned.injection == "paper":
        faults.append(f"filter.injection: 'paper' knows one object: {cure}")
    if learned.motion == "push":
        faults.append(f"filter.motion: a pushed object must be known: {cure}")


def _of_objects(config: Config) -> list[str]:
    """Keys that are set and mean nothing without an object."""
    found = list[str]()
    tables: dict[str, Any] = {name: getattr(config, name) for name in ("filter", "budget")}
    for name, table in tables.items():
        usual = type(table)()
        keys = (each.name for each in fields(table))
        found += [f"{name}.{key}" for key in keys if getattr(table, key) != getattr(usual, key)]
    return found


def _check_endpoints(config: Config, faults: list[str]) -> None:
    for key, relay_key, named in (
        ("publish.endpoints", "relay.publish", config.publish.endpoints),
        ("control.endpoint", "relay.control", (config.control.endpoint,)),
    ):
        found = (endpoints.served_fault(each, relay_key) for each in named if each)
        faults += [f"{key}: {fault}" for fault in found if fault]
    for key, named in (
        ("sensor_pose.endpoint", (config.sensor_pose.endpoint,)),
        ("relay.publish", config.relay.publish),
        ("relay.control", (config.relay.control,)),
    ):
        found = (endpoints.fault(each, bool(config.curve.directory)) for each in named if each)
        faults += [f"{key}: {fault}" for fault in found if fault]


def _for_this_user(config: Config) -> Config:
    """The configuration with the user's own endpoints where the service's are closed to them."""
    own = endpoints.for_this_user
    return replace(
        config,
        publish=replace(config.publish, endpoints=tuple(map(own, config.publish.endpoints))),
        control=replace(config.control, endpoint=own(config.control.endpoint)),
    )
