"""Checks across the tables of several links, `[[skin]]`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, replace

from taxeld.config.tables import Config, SourceConfig
from taxeld.config.toml_tables import ConfigError, Given

LINKS_MAX = 8
SENSOR_POSE = "/robot/sensor_pose"  # the first link's topic


def completed(config: Config) -> Config:
    """The configuration with the links' names and topics; the first one stands in its own tables
    as well.

    Raises:
        ConfigError: a link's source has no kind.
    """
    if not config.links:
        return config
    faults = [
        f"skin[{k}].source.kind: is required"
        for k, link in enumerate(config.links)
        if link.source.keys and "kind" not in link.source.keys
    ]
    if faults:
        raise ConfigError(faults)
    common: Given[SourceConfig] = Given(
        {each.name: getattr(config.source, each.name) for each in fields(SourceConfig)}
    )
    named = tuple(
        replace(
            link, name=link.name or f"link{k}", source=link.source if link.source.keys else common
        )
        for k, link in enumerate(config.links, 1)
    )
    first = replace(config, links=named).of_link(0)
    return replace(first, links=named)


def faults(config: Config) -> list[str]:
    """What is wrong with several links together, a line each."""
    links = config.links
    if not links:
        return []
    found = []
    if len(links) > LINKS_MAX:
        found.append(f"skin: has {len(links)} links; {LINKS_MAX} at most")
    for key, values in (
        ("name", [link.name for link in links]),
        ("calibration", [link.calibration for link in links]),
        ("sensor_pose.topic", topics(config) if config.sensor_pose.endpoint else []),
    ):
        found += [
            f"skin[{k}].{key}: {values[k]!r} is that of skin[{j}] already"
            for j, k in _twice(values)
        ]
    shared = buses(config)
    for bus, (k, *_) in shared:
        if bus.kind in ("can", "serial") and not bus.channel and k:
            found.append(f"skin[{k}].source.channel: is required for kind '{bus.kind}'")
    places = [f"{bus.kind} {bus.where}" if bus.where else "" for bus, _ in shared]
    for j, k in _twice(places):
        one, two = shared[j][1][0], shared[k][1][0]
        found.append(
            f"skin[{two}].source: {places[k]} is of {links[one].name} already, with other keys; "
            "name it in [source], for both"
        )
    if sum(bus.kind == "array" for bus, _ in shared) > 1:
        found.append("skin.source: one array is heard at most; give the others a bus")
    if any(link.name in (".", "..") or {"/", "\0"} & {*link.name} for link in links):
        found.append("skin.name: must be the name of a directory, without /")
    return found


def topics(config: Config) -> list[str]:
    """The topics of the links' sensor poses."""
    return [topic or SENSOR_POSE for topic in config.topics]


def buses(config: Config) -> list[tuple[SourceConfig, list[int]]]:
    """Each source with the numbers of the links on it, that of the first link first."""
    shared: list[tuple[SourceConfig, list[int]]] = []
    for k in range(len(config.names)):
        source = config.of_link(k).source
        common = next((numbers for bus, numbers in shared if bus == source), None)
        if common is None:
            shared.append((source, [k]))
        else:
            common.append(k)
    return shared


def _twice(values: Sequence[str]) -> list[tuple[int, int]]:
    """Numbers of values that are equal and not empty: the first and each further one."""
    times = Counter(value for value in values if value)
    return [
        (values.index(value), k)
        for k, value in enumerate(values)
        if times[value] > 1 and values.index(value) < k
    ]
