"""Devices that connect a skin: a CAN interface, or a serial line."""

import difflib

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.device import Device
from taxeld.source.lines import SerialDevice
from taxeld.source.slcan_device import SlcanDevice
from taxeld.source.socketcan_device import SocketCanDevice

NAME_MAX = 15  # characters of an interface's name (IFNAMSIZ)


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
        if "/" in config.channel or len(config.channel) > NAME_MAX:
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
