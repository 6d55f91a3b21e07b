"""A short session, read whole."""

from pathlib import Path

from taxeld.source import session
from taxeld.source.session import Item, PoseRow
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Chunk, Frame


def read(directory: Path, link: int = 0) -> tuple[list[Item], list[PoseRow]]:
    """What came of a source, by its first link, and the poses of that link."""
    items: list[Item] = []
    poses: list[PoseRow] = []
    for record in session.records(directory):
        if record.link != link:
            continue
        if isinstance(record.item, Frame | Chunk | ArrayFrame):
            items.append(record.item)
        else:
            poses.append(record.item)
    return items, poses


def items_of(directory: Path, link: int = 0) -> list[Item]:
    return read(directory, link)[0]


def poses_of(directory: Path, link: int = 0) -> list[PoseRow]:
    return read(directory, link)[1]
