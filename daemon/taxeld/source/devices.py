"""Devices that connect a skin: a CAN interface, or a serial line."""

from taxeld.config.tables import SourceConfig
from taxeld.source.device import Device
from taxeld.source.dialects import ToFrames
from taxeld.source.lines import SerialDevice
from taxeld.source.slcan_device import SlcanDevice
from taxeld.source.socketcan_device import SocketCanDevice


def open_device(config: SourceConfig, to_frames: ToFrames) -> Device:
    """The configured device, opened.

    Raises:
        AwayError: it is missing or busy.
        SetupError: it can never be opened with this configuration.
    """
    if config.kind == "can" and config.interface == "socketcan":
        return SocketCanDevice(config, to_frames)
    if config.kind == "can" and config.interface != "slcan":
        # python-can takes a tenth of the start's time and memory, so it is imported only if needed
        from taxeld.source.can_device import CanDevice  # noqa: PLC0415

        return CanDevice(config, to_frames)
    native = config.kind == "serial" and config.framing == "native"
    return (SerialDevice if native else SlcanDevice)(config, to_frames)
