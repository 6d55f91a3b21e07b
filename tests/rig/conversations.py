"""The conversations of firmware_protocol/vectors: how a device or a host is held against one."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from taxeld_protocol.frames import Frame, parse_log_line

FOLDER = Path(__file__).parents[2] / "firmware_protocol" / "vectors" / "conversations"
NAMES = [path.stem for path in sorted(FOLDER.glob("*.json"))]
TICK_S = 0.01
PATIENCE_S = 30.0  # of a host, on its own clock


@dataclass(frozen=True, slots=True)
class Line:
    """What one side says."""

    of_host: bool
    frames: list[Frame]
    counts: list[int] | None  # of a scan: what the device's channels read,
    taxels: dict[int, int]  # and what the host must make of it: UID → count
    device: int = 0
    after_s: float = 0.0  # least time since the host's line before


@dataclass(frozen=True, slots=True)
class Conversation:
    """A file of the folder."""

    name: str
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


class Host(Protocol):
    """A host on a clock of the test's."""

    taxels: dict[int, int]  # UID → count, of the last scan

    def step(self, now_s: float, heard: list[Frame]) -> list[Frame]:
        """Take what came up to this time; → what it sends."""
        ...


def load(name: str) -> Conversation:
    value = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    script = [
        Line(
            line["from"] == "host",
            _frames(line["frames"]),
            line.get("counts"),
            {int(uid): count for uid, count in line.get("taxels", {}).items()},
            line.get("device", 0),
            line.get("after_ms", 0) / 1000.0,
        )
        for line in value["script"]
    ]
    return Conversation(name, value["host"], value["devices"], script)


def hold_device(
    conversation: Conversation,
    hear: Callable[[Frame], list[Frame]],
    scan: Callable[[Line], list[Frame]],
) -> None:
    """A device (or all of them) must say what the conversation has, and nothing else. `hear`: a
    frame of the host's → what is answered; `scan`: a line with counts → the scan that falls due."""
    for asked, answered in conversation.turns:
        said = [got for line in asked for frame in line.frames for got in hear(frame)]
        wanted = [frame for line in answered if line.counts is None for frame in line.frames]
        assert said == wanted
        for line in answered:
            if line.counts is not None:
                assert scan(line) == line.frames


def hold_host(conversation: Conversation, host: Host) -> None:
    """A host must ask what the conversation has, after its pauses and nothing else, and read its
    scans."""
    now = last = 0.0
    heard: list[Frame] = []
    for asked, answered in conversation.turns:
        wanted = [frame for line in asked for frame in line.frames]
        said: list[Frame] = []
        times: list[float] = []
        until = now + PATIENCE_S
        while len(said) < len(wanted) and now < until:
            said += host.step(now, heard)
            times += [now] * (len(said) - len(times))
            heard, now = [], round(now + TICK_S, 6)
        assert said == wanted
        for line in asked:
            [begin, *_], times = times[: len(line.frames)], times[len(line.frames) :]
            assert round(begin - last, 6) >= line.after_s, line
            last = begin
        for line in answered:
            heard += [frame._replace(t=now) for frame in line.frames]
            if line.counts is not None:
                assert host.step(now, heard) == []
                assert host.taxels == line.taxels
                heard = []
    for _ in range(20):  # shorter than a silence
        assert host.step(now, []) == []
        now = round(now + TICK_S, 6)


def _frames(texts: list[str]) -> list[Frame]:
    frames = [parse_log_line(text) for text in texts]
    assert None not in frames, texts
    return [frame for frame in frames if frame is not None]
