"""The skins' protocols: for each, its decoder, its bring-up, and the form of its requests."""

import math
from collections.abc import Callable
from typing import NamedTuple

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.source import icub_part, module_order
from taxeld.source.bring_up import BringUp
from taxeld.source.icub_bring_up import IcubBringUp
from taxeld.source.module_order import Listening, RecordedModules
from taxeld.source.session import Items
from taxeld_protocol import cyskin, icub
from taxeld_protocol.array import ArrayDecoder, ArrayFrame
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER
from taxeld_protocol.decoder import Decoder, ScanDecoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.icub_decoder import IcubDecoder
from taxeld_protocol.modules import NAMES, wired

ToFrames = Callable[[int, bytes], list[Frame]]

FRAME_BITS = 116  # a frame with 8 bytes and a short id, with the stuff bits of usual readings


class Dialect(NamedTuple):
    """A protocol, ready for one source."""

    decoder: ScanDecoder
    bring_up: BringUp | IcubBringUp | None  # None: never send
    to_frames: ToFrames  # a request as CAN frames
    listening: Listening | None = None  # set where something else starts the skin


def live(config: SourceConfig, layout: Layout) -> Dialect:
    """The configured dialect for a live skin.

    Raises:
        SetupError: the layout needs more boards than are configured, or their order is unknown; or
            its scans are more than the bus carries.
    """
    least_ms = least_period_ms(config, layout)
    if config.period_ms < least_ms:
        rate = 1000 * _frames(config, layout) / config.period_ms
        raise SetupError(
            f"source.period_ms: {len(wired(layout.uid.tolist()))} modules every {config.period_ms} "
            f"ms are {rate:.0f} frames/s, and a bus of {config.bitrate} bit/s carries "
            f"{config.bitrate // FRAME_BITS}: at least {least_ms} ms"
        )
    if config.dialect == "icub":
        if config.listen_only:
            return Dialect(icub_part.listened(config, layout), None, icub.to_frames)
        part = icub_part.of(layout)
        boards = part.named(config.boards)
        skin = IcubDecoder(boards, part.taxels)
        return Dialect(skin, IcubBringUp(skin, part, boards, config), icub.to_frames)
    if any(int(uid) & 0xF >= NAMES for uid in layout.uid):
        raise SetupError(
            "skin.layout: its UIDs are of no module, which has taxels "
            f"1..{NAMES - 1}: it is of an array (source.kind)"
        )
    if config.listen_only:
        decoder = Decoder(module_order.given(config, layout).of, config.period_ms / 1000.0)
        return Dialect(decoder, None, _to_frames, Listening(decoder))
    # a bring-up asks the hubs for their modules, so the decoder must not guess them
    decoder = Decoder(period_s=config.period_ms / 1000.0)
    suis = {int(uid) >> 4 for uid in layout.uid}
    return Dialect(decoder, BringUp(decoder, config.period_ms, suis), _to_frames)


def _to_frames(to: int, body: bytes) -> list[Frame]:
    if to == LEAVE_BOOTLOADER:
        return cyskin.to_frames(to, ihb=BROADCAST)
    return cyskin.to_frames(body[0], body[1:], ihb=to)


def least_period_ms(config: SourceConfig, layout: Layout) -> int:
    """The shortest period at which a CAN bus carries the layout's scans; 0 without a bus."""
    if config.kind == "serial" and config.framing == "native":
        return 0
    return math.ceil(1000 * _frames(config, layout) * FRAME_BITS / config.bitrate)


def _frames(config: SourceConfig, layout: Layout) -> int:
    """The least frames of a scan."""
    modules = wired(layout.uid.tolist())
    if config.dialect == "icub":
        return 2 * len(modules)
    return cyskin.scan_frames(sum(module.channels for module in modules))


def of_array(config: SourceConfig, layout: Layout) -> ArrayDecoder:
    """The decoder of an array that has this layout."""
    return ArrayDecoder(layout.uid.tolist(), config.array)


def replayed(
    config: SourceConfig, layout: Layout, items: Items, what: str
) -> ScanDecoder | ArrayDecoder:
    """The decoder of the configured dialect for a recording, named by `what`. CySkin's decoder
    raises SetupError later on for a hub whose modules are unknown.

    Raises:
        SetupError: the modules or boards of the first scan are unknown.
    """
    if items and isinstance(items[0], ArrayFrame):
        return of_array(config, layout)
    if config.dialect == "icub":
        return icub_part.replayed(config, layout, [*items], what)
    given = module_order.given(config, layout)
    known = RecordedModules(config, given, items, what)
    return Decoder(known.of, config.period_ms / 1000.0)
