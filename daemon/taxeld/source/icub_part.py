"""The part of an iCub that a layout describes: its boards, their triangles, their taxels.

A part's boards are named in the configuration, in the order of the positions file. Otherwise they
are the boards that answer, ascending, if these are as many as the part has.
"""

from collections.abc import Sequence
from typing import NamedTuple

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.source.session import Chunk
from taxeld.source.wire import Wire
from taxeld_protocol import icub
from taxeld_protocol.frames import Frame
from taxeld_protocol.icub import TRIANGLES
from taxeld_protocol.icub_decoder import IcubDecoder


class Part(NamedTuple):
    """The boards and triangles of a part that have taxels in the layout."""

    name: str  # name of the layout
    triangles: tuple[int, ...]  # each board's, in the file's order: bit k for triangle k
    taxels: dict[int, int]  # SUI → its taxels: bit k for channel k

    def named(self, boards: tuple[int, ...]) -> tuple[int, ...]:
        """The configured boards that carry the taxels; empty where none are configured.

        Raises:
            SetupError: they are too few.
        """
        needed = len(self.triangles)
        if 0 < len(boards) < needed:
            raise SetupError(
                f"source.boards: names {len(boards)}, but {self.name} has the triangles of "
                f"{needed}; add the missing"
            )
        return boards[:needed]

    def untold(self, why: str) -> str:
        """A line for unknown boards, with the cure; `why` gives the reason."""
        return (
            f"source.boards: must name the {len(self.triangles)} boards of {self.name}, in the "
            f"order of its positions file: {why}"
        )

    def mismatch(self, boards: Sequence[int]) -> str:
        """A line for a wrong number of answering boards, with the cure."""
        return (
            f"{listing(boards)} answer{'s' * (len(boards) == 1)}, but {self.name} has the triangles"
            f" of {len(self.triangles)}; name the part's, in the order of its positions file"
        )


def of(layout: Layout) -> Part:
    """The part that a layout describes.

    Raises:
        SetupError: it has more boards than a bus can have.
    """
    taxels: dict[int, int] = {}
    for uid in layout.uid.tolist():
        taxels[uid >> 4] = taxels.get(uid >> 4, 0) | 1 << (uid & 0xF)
    needed = max(taxels) // TRIANGLES + 1
    if needed > len(icub.BOARDS):
        raise SetupError(
            f"skin.layout: {layout.name} has the triangles of {needed} boards, and a bus "
            f"{len(icub.BOARDS)}; name an iCub positions file, or the dialect of this one"
        )
    triangles = [0] * needed
    for sui in taxels:
        triangles[sui // TRIANGLES] |= 1 << sui % TRIANGLES
    return Part(layout.name, tuple(triangles), taxels)


def listened(config: SourceConfig, layout: Layout) -> IcubDecoder:
    """The decoder for boards that something else starts.

    Raises:
        SetupError: the configuration does not name the boards.
    """
    part = of(layout)
    boards = part.named(config.boards)
    if not boards:
        raise SetupError(part.untold("with listen_only none is asked"))
    return IcubDecoder(boards, part.taxels)


def replayed(
    config: SourceConfig, layout: Layout, recorded: Sequence[Frame | Chunk], what: str
) -> IcubDecoder:
    """The decoder for a recording, named by `what`.

    Raises:
        SetupError: neither the configuration nor an answer in the recording names the boards.
    """
    part = of(layout)
    boards = part.named(config.boards) or _answering(config, recorded)
    if not boards:
        raise SetupError(part.untold(f"{what} has no board's answer"))
    if len(boards) != len(part.triangles):
        raise SetupError(f"source.boards: {part.mismatch(boards)}")
    return IcubDecoder(boards, part.taxels)


def _answering(config: SourceConfig, recorded: Sequence[Frame | Chunk]) -> tuple[int, ...]:
    skin = IcubDecoder()
    Wire(config, skin).take(recorded)
    return tuple(sorted(answer.board for answer in skin.answered.values() if answer.is_skin))


def listing(boards: Sequence[int]) -> str:
    """ "board 9", "boards 4, 9", "boards 1..14"."""
    first, last = boards[0], boards[-1]
    if len(boards) == 1:
        return f"board {first}"
    if len(boards) > 2 and list(boards) == list(range(first, last + 1)):
        return f"boards {first}..{last}"
    return f"boards {', '.join(map(str, boards))}"
