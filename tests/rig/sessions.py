"""A short session, written and read whole."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from taxeld.commands.replay import RecordedInputs, open_pipeline
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.source.session import Item, Pass, SensorPose
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Chunk, Frame
from tests.rig.configurations import Table, config


def write(directory: Path, items: Iterable[Item], *, moves: bool = False, **more: Any) -> None:
    """What came one after the other, as to a loop that works on each; `more`: of Recorder."""
    with Recorder(directory, moves=moves, **more) as recorder:
        for item in items:
            recorder.take(item)
            recorder.take(Pass(item.t))


def recorded_inputs(directory: Path, **tables: Table) -> RecordedInputs:
    """The sources of a session under a configuration of these tables."""
    return RecordedInputs(directory, open_pipeline(directory, config(**tables)))


def items_of(directory: Path, link: int = 0) -> list[Frame | Chunk | ArrayFrame]:
    """What came of a source, by its first link."""
    items = [each.item for each in session.arrivals(directory) if each.link == link]
    return [item for item in items if isinstance(item, Frame | Chunk | ArrayFrame)]


def poses_of(directory: Path, link: int = 0) -> list[SensorPose]:
    items = [each.item for each in session.arrivals(directory) if each.link == link]
    return [item for item in items if isinstance(item, SensorPose)]
