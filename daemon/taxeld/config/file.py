"""The configuration file: read, and checked where keys must agree."""

from dataclasses import replace
from pathlib import Path

from taxeld.config import endpoints, toml_tables
from taxeld.config.tables import Config, SourceConfig
from taxeld.config.toml_tables import ConfigError
from taxeld_protocol import icub

MAX_BYTES = 1_000_000
SHIPPED = Path(__file__).parents[1] / "bundles"


def load(path: Path) -> Config:
    """Read and validate a configuration file.

    Raises:
        ConfigError: all faults at once.
    """
    config = _for_this_user(parse(text_of(path), str(path)))
    skin, scene = config.skin, config.scene
    if skin.calibration:
        # an absolute path stays what it is
        skin = replace(skin, calibration=str(path.parent / skin.calibration))
    skin = replace(skin, layout=_beside(path, skin.layout))
    scene = replace(scene, bundle=_beside(path, scene.bundle, SHIPPED))
    return replace(config, skin=skin, scene=scene)


def text_of(path: Path) -> str:
    """A TOML file's text.

    Raises:
        ConfigError: it is unreadable, or too large to be one.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ConfigError([f"{path}: is larger than {MAX_BYTES} bytes; name a configuration"])
        return content.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: unreadable configuration ({error})"]) from None


def parse(text: str, name: str = "configuration") -> Config:
    """Validate configuration text.

    Raises:
        ConfigError: all faults at once.
    """
    config = toml_tables.parse(Config, text, name)
    faults: list[str] = []
    _check_source(config.source, faults)
    _check_rate(config, faults)
    _check_metrics(config.metrics.file, faults)
    _check_endpoints(config, faults)
    if config.source.dialect == "icub":
        _check_icub(config, faults)
    if faults:
        raise ConfigError(faults)
    return config


def _beside(path: Path, name: str, shipped: Path | None = None) -> str:
    """What a configuration at `path` names, from where it lies, unless it is `shipped`; else from
    the shell's directory, as a session is replayed that keeps the configuration and not the
    bundle."""
    try:
        if shipped is not None and (shipped / name).is_dir():
            return name
        return str(path.parent / name) if (path.parent / name).exists() else name
    except (OSError, ValueError):  # no path at all, or not ours to see
        return name


def _check_source(source: SourceConfig, faults: list[str]) -> None:
    if source.kind in ("can", "serial") and not source.channel:
        faults.append(f"source.channel: is required for kind '{source.kind}'")
    if source.modules and source.dialect != "cyskin":
        faults.append("source.modules: is of dialect cyskin; icub names its boards")
    if source.kind == "replay" and not source.path:
        faults.append("source.path: is required for kind 'replay'")


def _check_rate(config: Config, faults: list[str]) -> None:
    """Whether a tick has room for what each touch takes: samples keep to what is left of it."""
    budget = config.budget
    needed_ms = budget.source_ms + budget.skin_ms + budget.filter_ms + budget.publish_ms
    if budget.degrade and needed_ms * config.loop.rate_hz > 1000.0:
        faults.append(
            f"loop.rate_hz: {config.loop.rate_hz:g} leaves {1000.0 / config.loop.rate_hz:.1f} ms a "
            f"tick, and budget has {needed_ms:g} for it without samples; use "
            f"{int(1000.0 / needed_ms)} or less, or smaller budgets"
        )


def _check_metrics(file: str, faults: list[str]) -> None:
    path = Path(file)
    if file and (path.suffix != ".prom" or not path.is_absolute()):
        faults.append(f"metrics.file: {file} must be an absolute path that ends with .prom")


def _check_endpoints(config: Config, faults: list[str]) -> None:
    has_keys = bool(config.curve.directory)
    if config.curve.loopback and not has_keys:
        faults.append("curve.directory: is required with curve.loopback")
    for name, used, relay_key in (
        ("publish.endpoints", config.publish.endpoints, "relay.publish"),
        ("control.endpoint", (config.control.endpoint,), "relay.control"),
    ):
        served = (endpoints.served_fault(endpoint, relay_key) for endpoint in filter(None, used))
        faults += [f"{name}: {fault}" for fault in served if fault]
    for name, used in (
        ("sensor_pose.endpoint", (config.sensor_pose.endpoint,)),
        ("relay.publish", config.relay.publish),
        ("relay.control", (config.relay.control,)),
    ):
        found = (endpoints.fault(endpoint, has_keys) for endpoint in filter(None, used))
        faults += [f"{name}: {fault}" for fault in found if fault]


def _for_this_user(config: Config) -> Config:
    """With the user's own endpoints, where the service's are closed to them."""
    own = endpoints.for_this_user
    return replace(
        config,
        publish=replace(config.publish, endpoints=tuple(map(own, config.publish.endpoints))),
        control=replace(config.control, endpoint=own(config.control.endpoint)),
    )


def _check_icub(config: Config, faults: list[str]) -> None:
    source, counts = config.source, config.skin.full_scale_counts
    if source.kind == "serial" and source.framing == "native":
        faults.append("source.dialect: icub is spoken on CAN alone; use framing 'slcan'")
    if source.period_ms > icub.PERIOD_MAX_MS:
        faults.append(
            f"source.period_ms: must be 1..{icub.PERIOD_MAX_MS} with dialect icub, "
            f"not {source.period_ms}"
        )
    if counts > icub.VALUE_MAX:
        faults.append(
            f"skin.full_scale_counts: must be 1..{icub.VALUE_MAX} with dialect icub, "
            f"whose values have 8 bits, not {counts:g}"
        )
