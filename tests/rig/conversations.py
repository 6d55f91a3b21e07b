"""The conversations of firmware_protocol/vectors: how a device or a host is held against one."""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from taxeld_protocol.frames import Frame, parse_log_line

FOLDER = Path(__file__).parents[2] / "firmware_protocol" / "vectors" / "conversations"
NAMES = [path.stem for path in sorted(FOLDER.glob("*.json"))]
TICK_S = 0.01
PATIENCE_S = 30.0  # of a host, on its own clock

Taxels = dict[int, int]  # UID → count
Step = Callable[[float, list[Frame]], tuple[list[Frame], Taxels]]


class Line(NamedTuple):
    """What one side says."""

    of_host: bool
    frames: list[Frame]
    counts: list[int] | None  # of a scan: what the device's channels read,
    taxels: Taxels  # and what the host must make of it
    after_s: float  # least time since the host's line before


@dataclass(frozen=True, slots=True)
class Conversation:
    """A file of the folder."""

    host: dict[str, Any]
    devices: list[dict[str, Any]]
    script: list[Line]

    @property
    def turns(self) -> Iterator[tuple[list[Line], list[Line]]]:
        """What the host says in one go, and what it is answered."""
        asked: list[Line] = []
        answered: list[Line] = []
        for line in self.script:
            if line.of_host and answered:
                yield asked, answered
                asked, answered = [], []
            (asked if line.of_host else answered).append(line)
        yield asked, answered


def load(name: str) -> Conversation:
    value = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    script = [
        Line(
            line["from"] == "host",
            frames_of(line["frames"]),
            line.get("counts"),
            {int(uid): count for uid, count in line.get("taxels", {}).items()},
            line.get("after_ms", 0) / 1000.0,
        )
        for line in value["script"]
    ]
    return Conversation(value["host"], value["devices"], script)


def hold_device(
    conversation: Conversation,
    hear: Callable[[Frame], list[Frame]],
    scan: Callable[[list[int]], list[Frame]],
) -> None:
    """A device (or all of them) must say what the conversation has, and nothing else. `hear`: a
    frame of the host's → what is answered; `scan`: counts → the scan that falls due."""
    for asked, answered in conversation.turns:
        said = [got for line in asked for frame in line.frames for got in hear(frame)]
        for line in answered:
            said += [] if line.counts is None else scan(line.counts)
        assert said == [frame for line in answered for frame in line.frames]


def hold_host(conversation: Conversation, step: Step) -> None:
    """A host must ask what the conversation has, after its pauses and nothing else, and read its
    scans. `step`: a time on a clock of the test's, and what came up to then → what the host sends,
    and the last scan."""
    now = last = 0.0
    heard: list[Frame] = []
    for asked, answered in conversation.turns:
        said: list[tuple[float, Frame]] = []
        wanted = [frame for line in asked for frame in line.frames]
        until = now + PATIENCE_S
        while len(said) < len(wanted) and now < until:
            said += [(now, frame) for frame in step(now, heard)[0]]
            heard, now = [], round(now + TICK_S, 6)
        assert [frame for _, frame in said] == wanted
        for line in asked:
            (begin, _), said = said[0], said[len(line.frames) :]
            assert round(begin - last, 6) >= line.after_s, line
            last = begin
        for line in answered:
            heard += [frame._replace(t=now) for frame in line.frames]
            if line.counts is not None:
                assert step(now, heard) == ([], line.taxels)
                heard = []
    for _ in range(20):  # shorter than a silence
        assert step(now, [])[0] == []
        now = round(now + TICK_S, 6)


def frames_of(texts: Iterable[str]) -> list[Frame]:
    frames = [parse_log_line(text) for text in texts]
    assert None not in frames, texts
    return [frame for frame in frames if frame is not None]
