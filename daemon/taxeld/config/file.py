"""The configuration file: reading, and checks across keys."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from taxeld import files
from taxeld.config import endpoints, gate
from taxeld.config.gate import ConfigError
from taxeld.config.tables import (
    KINDS,
    LINKS_MAX,
    SIZES,
    Config,
    FilterConfig,
    LinkConfig,
    SkinConfig,
)

CONFIG_BYTES = 64_000  # ten times the length of a file from `taxeld init`, with all comments
TOML_BYTES = 1_000_000  # limit for any other TOML file; a calibration has a line for each taxel
SHIPPED = Path(__file__).parents[1] / "bundles"

Skin = TypeVar("Skin", bound=SkinConfig)


def load(path: Path) -> Config:
    """Read and validate a configuration file. Paths in it start at its directory, and the service's
    endpoints give way to the user's own where they are closed to this user.

    Raises:
        ConfigError: all faults at once.
    """
    config = parse(text_of(path, CONFIG_BYTES), str(path))

    def placed(skin: Skin) -> Skin:
        calibration = skin.calibration and str(path.parent / skin.calibration)
        return replace(skin, layout=_beside(path, skin.layout), calibration=calibration)

    scene, own = config.scene, endpoints.for_this_user
    bundles = tuple(_beside(path, name, SHIPPED) for name in scene.bundles)
    return replace(
        config,
        skin=placed(config.skin),
        links=tuple(placed(link) for link in config.links),
        scene=replace(scene, bundle=_beside(path, scene.bundle, SHIPPED), bundles=bundles),
        publish=replace(config.publish, endpoints=tuple(map(own, config.publish.endpoints))),
        control=replace(config.control, endpoint=own(config.control.endpoint)),
    )


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
    faults: list[str] = []
    given, links = gate.loads(text, name), tuple[LinkConfig, ...]()
    data, own = given, None  # own: the source of the first of several links
    if isinstance(given.get("skin"), list):
        links = gate.value(tuple[LinkConfig, ...], given["skin"], faults, "skin")
        own = links[0].source if links and links[0] else None
        data = ({"source": {"kind": KINDS[0]}} if own else {}) | given | {"skin": {}}
    config = gate.take(Config, data, faults)
    if config is None or faults:
        raise ConfigError(faults)
    if links:
        common = own if own and "source" not in given else config.source
        links = tuple(
            replace(link, name=link.name or f"link{k}", source=link.source or common)
            for k, link in enumerate(links, 1)
        )
        config = replace(config, links=links, skin=links[0], source=links[0].source or common)
    config = replace(config, is_sized=not given.get("filter", {}).keys().isdisjoint(SIZES))
    if faults := list(_faults(config)):
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


def _faults(config: Config) -> Iterator[str]:
    """What is wrong with keys together, a line each."""
    for source, (link, *_) in config.buses:
        at = f"skin[{link}]." if link else ""
        if source.kind != "array" and not source.channel:
            yield f"{at}source.channel: is required for kind '{source.kind}'"
        elif source.kind == "array" and (fault := endpoints.fault(source.endpoint)):
            yield f"{at}source.endpoint: {fault}"
    yield from _scene_faults(config)
    yield from _link_faults(config)
    robot = config.sensor_pose.endpoint
    for key, endpoint in [*config.served, *[("sensor_pose.endpoint", robot)] * bool(robot)]:
        relay = {"publish.endpoints": "relay.publish", "control.endpoint": "relay.control"}
        if key in relay and endpoint.startswith(endpoints.TCP):
            yield (
                f"{key}: '{endpoint}' is of TCP: name it in {relay[key]}; "
                "here stands ipc:///path alone"
            )
        elif fault := endpoints.fault(endpoint, bool(config.curve.directory)):
            yield f"{key}: {fault}"


def _scene_faults(config: Config) -> Iterator[str]:
    scene, own, usual = config.scene, config.filter, FilterConfig()
    if not scene.names:
        for key in gate.keys_of(FilterConfig):
            if getattr(own, key.name) != getattr(usual, key.name):
                yield (
                    f"filter.{key.name}: needs an object: name it in scene.bundle, "
                    "or leave this out"
                )
    if scene.bundle and scene.bundles:
        yield "scene.bundles: is given beside scene.bundle; keep one of the two"
    if own.injection == "paper" and own.motion == "push":
        yield "filter.motion: 'push' needs filter.injection = 'mixture'"
    if len(scene.names) > 1 and own.injection == "paper":
        yield "filter.injection: 'paper' knows one object: name one scene.bundle"
    if len(scene.names) > 1 and own.motion == "push":
        yield "filter.motion: a pushed object must be known: name one scene.bundle"


def _link_faults(config: Config) -> Iterator[str]:
    links, buses = config.links, config.buses
    if len(links) > LINKS_MAX:
        yield f"skin: has {len(links)} links; {LINKS_MAX} at most"
    for key, values in (
        ("name", config.names),
        ("calibration", [link.calibration for link in links]),
        ("sensor_pose.topic", config.topics if config.sensor_pose.endpoint else ()),
    ):
        for j, k in _twice(values):
            yield f"skin[{k}].{key}: {values[k]!r} is that of skin[{j}] already"
    for j, k in _twice([source.where and f"{source.kind} {source.where}" for source, _ in buses]):
        (one, (link, *_)), (_, (other, *_)) = buses[j], buses[k]
        yield (
            f"skin[{other}].source: {one.kind} {one.where} is of {links[link].name} already, "
            "with other keys; name it in [source], for both"
        )
    if sum(source.kind == "array" for source, _ in buses) > 1:
        yield "skin.source: one array is heard at most; give the others a bus"
    if any(link.name in (".", "..") or "/" in link.name for link in links):
        yield "skin.name: must be the name of a directory, without /"


def _twice(values: Sequence[str]) -> list[tuple[int, int]]:
    """Numbers of values that are equal and not empty: the first and each further one."""
    firsts = [values.index(value) for value in values]
    return [(j, k) for k, j in enumerate(firsts) if j != k and values[k]]
