"""What TARGET names: a source of the daemon's, and how it is opened."""

from dataclasses import replace

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.source.device import BusyError
from taxeld.source.lines import line_speed
from taxeld.source.recorder import Recorder
from taxeld.source.slcan_device import ADAPTER_BAUD
from taxeld.source.sources import Source, open_source

CURES = {
    "can": "bring it up: ip link set {channel} up type can bitrate {bitrate}",
    "slcan": "is it plugged in, and may you use it?",
    "serial": "is it plugged in, and may you use it?",
}


def source_of(target: str, period_ms: int) -> SourceConfig:
    """The daemon's source for `can:CHANNEL`, `serial:DEVICE[@BAUD]`, or `INTERFACE:CHANNEL` of any
    interface that python-can knows.

    Raises:
        SetupError: it is none of them.
    """
    kind, _, channel = target.partition(":")
    if not kind or not channel:
        raise SetupError(
            f"TARGET: '{target}' is none; use can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0, "
            "or a python-can interface and its channel, as pcan:PCAN_USBBUS1"
        )
    device, at, baud = channel.partition("@")
    is_line = kind in ("serial", "slcan")
    speed = line_speed(baud) if at and is_line else None
    if at and is_line and speed is None:
        raise SetupError(f"TARGET: '{baud}' is no baud rate; use {kind}:{device}@{ADAPTER_BAUD}")
    if kind == "serial":
        config = SourceConfig(kind="serial", channel=device, period_ms=period_ms)
        return config if speed is None else replace(config, baud=speed)
    interface = "socketcan" if kind == "can" else kind
    return SourceConfig(kind="can", interface=interface, channel=channel, period_ms=period_ms)


def opened(target: str, config: SourceConfig, layout: Layout, recorder: Recorder) -> Source:
    """The source of a target.

    Raises:
        SetupError: it cannot be opened, or another process has it.
    """
    try:
        return open_source(config, layout, recorder)
    except SetupError as error:
        said = str(error).partition(": ")[2]  # without the key of a configuration: there is none
        cure = CURES.get(
            target.partition(":")[0], "is the adapter plugged in, its driver installed?"
        )
        cure = "; " + cure.format(channel=config.channel, bitrate=config.bitrate)
        if isinstance(error, BusyError):  # which says what to do
            cure = ""
        raise SetupError(f"TARGET {target}: {said}{cure}") from None
