"""The skins' protocols: for each, its decoder, its bring-up, and the form of its requests."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from taxeld.config.tables import SourceConfig
from taxeld.layout.layout import Layout
from taxeld.source import icub_part, module_order
from taxeld.source.bring_up import BringUp
from taxeld.source.icub_bring_up import IcubBringUp
from taxeld.source.module_order import Listening, RecordedModules
from taxeld.source.session import Items
from taxeld_protocol import cyskin, icub
from taxeld_protocol.cyskin import BROADCAST
from taxeld_protocol.decoder import Decoder, ScanDecoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.icub_decoder import IcubDecoder

ToFrames = Callable[[int, bytes], list[Frame]]


class Dialect(NamedTuple):
    """A protocol, ready for one source."""

    decoder: ScanDecoder
    bring_up: BringUp | IcubBringUp | None  # None: never send
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
    raises SetupError later on for a hub whose modules are unknown.

    Raises:
        SetupError: the modules or boards of the first scan are unknown.
    """
    if config.dialect == "icub":
        return icub_part.replayed(config, layout, items, what)
    given = module_order.given(config, layout)
    known = RecordedModules(config, given, items, what)
    return Decoder(known.of, config.period_ms / 1000.0)
