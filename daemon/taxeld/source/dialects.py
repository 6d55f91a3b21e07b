"""The skins' protocols: for each, its decoder, its bring-up, and the form of its requests."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple, Protocol

from taxeld.config.tables import SourceConfig
from taxeld.layout.layout import Layout
from taxeld.source import icub_part, module_order
from taxeld.source.bring_up import BringUp, Request
from taxeld.source.icub_bring_up import IcubBringUp
from taxeld.source.module_order import Listening, Recorded
from taxeld.source.session import Items
from taxeld_protocol import cyskin, icub
from taxeld_protocol.cyskin import BROADCAST, Packet
from taxeld_protocol.decoder import Decoder, ScanDecoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.icub_decoder import IcubDecoder


class Starter(Protocol):
    """A bring-up: decides what to send to get scans and to keep them coming."""

    waits_for: str  # a line on what the skin must still do; empty where nothing is missing

    def restart(self) -> None: ...

    def on_packet(self, packet: Packet, /) -> list[Request]: ...

    def on_scan(self, ihb: int, now_s: float) -> None: ...

    def due(self, now_s: float) -> Iterable[Request]: ...

    def stop(self) -> list[Request]: ...

    def news(self) -> list[str]: ...


ToFrames = Callable[[int, bytes], list[Frame]]


class Dialect(NamedTuple):
    """A protocol, ready for one source."""

    decoder: ScanDecoder
    bring_up: Starter | None  # None: never send
    to_frames: ToFrames  # a request as CAN frames
    listening: Listening | None = None  # set where something else starts the skin


def live(config: SourceConfig, layout: Layout) -> Dialect:
    """The configured dialect for a live skin.

    Raises:
        SetupError: the layout needs more boards than are configured, or their order is unknown.
    """
    if config.dialect == "icub":
        if config.listen_only:
            return Dialect(icub_part.listened(config, layout), None, icub.to_frames)
        part = icub_part.of(layout)
        boards = part.named(config.boards)
        skin = IcubDecoder(boards, part.taxels)
        start = IcubBringUp(skin, part, boards, config.period_ms, config.skin_type)
        return Dialect(skin, start, icub.to_frames)
    to_frames = partial(cyskin.to_frames, ihb=BROADCAST)
    if config.listen_only:
        decoder = Decoder(module_order.given(config, layout).of, config.period_ms / 1000.0)
        return Dialect(decoder, None, to_frames, Listening(decoder))
    # a bring-up asks the hubs for their modules, so the decoder must not guess them
    decoder = Decoder(period_s=config.period_ms / 1000.0)
    return Dialect(decoder, BringUp(decoder, config.period_ms), to_frames)


def replayed(config: SourceConfig, layout: Layout, items: Items, what: str) -> ScanDecoder:
    """The decoder of the configured dialect for a recording, named by `what`. CySkin's decoder
    raises SetupError while it decodes, where the modules are unknown.

    Raises:
        SetupError: the layout needs more boards than are configured, or their order is unknown.
    """
    if config.dialect == "icub":
        return icub_part.replayed(config, layout, items, what)
    module_order.given(config, layout)
    return Decoder(Recorded(config, items, what).of, config.period_ms / 1000.0)


def check_recording(config: SourceConfig, layout: Layout, items: Items, what: str) -> None:
    """Check that `replayed` can decode the first scan of a recording.

    Raises:
        SetupError: the modules or boards are unknown.
    """
    replayed(config, layout, items, what)
    if config.dialect == "cyskin":
        Recorded(config, items, what).check()
