"""Opens the sources of a configuration, and their devices."""

import difflib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack

from taxeld.config.tables import Config, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.source.device import Device
from taxeld.source.lines import SerialDevice, SlcanDevice
from taxeld.source.links import check_uids
from taxeld.source.socketcan import SocketCanDevice
from taxeld.source.sources import Source

INTERFACE_MAX = 15  # characters of an interface's name (IFNAMSIZ)

Open = Callable[[SourceConfig, Mapping[int, Layout]], Source]


def open_sources(
    config: Config, layouts: Sequence[Layout], open_one: Open, opened: ExitStack
) -> list[Source]:
    """All sources, that of the first link first, until `opened` ends; `layouts` of each link.
    `open_one` is given a source, and the layouts on it by the numbers of their links.

    Raises:
        SetupError: two layouts of one source have the same taxels, or `open_one` raises it.
    """
    found = list[Source]()
    for source, numbers in config.buses:
        check_uids([config.names[k] for k in numbers], [layouts[k] for k in numbers])
        found.append(open_one(source, {k: layouts[k] for k in numbers}))
        opened.callback(found[-1].close)
    return found


def open_device(config: SourceConfig) -> Device:
    """The configured device, opened.

    Raises:
        AwayError: it is missing or busy.
        SetupError: it can never be opened with this configuration.
    """
    if config.kind == "serial":
        return SerialDevice(config)
    if config.interface == "slcan":
        return SlcanDevice(config)
    if config.interface == "socketcan":
        if "/" in config.channel or len(config.channel) > INTERFACE_MAX:
            raise SetupError(
                f"source.channel: {config.channel} is no name of a CAN interface, as can0 is; for "
                'an SLCAN adapter set source.interface = "slcan"'
            )
        return SocketCanDevice(config)
    # python-can takes a tenth of the start's time and memory, so it is imported only if needed
    from taxeld.source.can_device import INTERFACES, CanDevice  # noqa: PLC0415

    if config.interface not in INTERFACES:
        near = difflib.get_close_matches(config.interface.lower(), INTERFACES, 1)
        hint = f"did you mean {near[0]}?" if near else f"it knows {', '.join(INTERFACES)}"
        raise SetupError(f"source.interface: python-can knows no '{config.interface}'; {hint}")
    return CanDevice(config)
