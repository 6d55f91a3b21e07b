"""`taxeld view`: streams or a session in Rerun's viewer, in a browser, or into a file."""

import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import rerun as rr

from taxeld.commands.unanswered import unanswered
from taxeld.errors import SetupError
from taxeld.stream import messages
from taxeld.view.live import Streams
from taxeld.view.space import Space
from taxeld.view.stage import Message, Stage, from_info

ANSWER_S = 5.0  # in which a daemon that is there has said who it is
LOOK_S = 0.2


@dataclass(frozen=True)
class Target:
    """Where it is shown: into the file `save`, in a browser, or in a window of its own."""

    save: Path | None = None
    web: bool = False

    def check(self) -> None:
        """Raises SetupError where nothing can be shown."""
        if self.save is None and not self.web:
            if sys.platform == "linux" and not _has_screen():
                raise SetupError("view: no screen here; use --save FILE, or --web for a browser")
            if shutil.which("rerun") is None and not _beside():
                raise SetupError("view: the program 'rerun' is not found; use --save or --web")

    def open(self) -> tuple[rr.RecordingStream, str]:
        """What takes entities, and a line on where they are seen."""
        stream = rr.RecordingStream("taxeld")
        if self.save is not None:
            try:
                self.save.open("wb").close()  # else the fault is told by another thread
            except OSError as error:
                raise SetupError(f"--save: cannot write {self.save} ({error.strerror})") from None
            stream.save(self.save)
            return stream, f"written: {self.save}; see it with: rerun {self.save}"
        if self.web:
            address = stream.serve_grpc()
            rr.serve_web_viewer(open_browser=False, connect_to=address)
            return stream, f"open in a browser: {_web_address(address)}"
        stream.spawn(executable_path=_beside())
        return stream, "the viewer is open"


def live(
    endpoint: str, keys: Path | None, known: Stage | None, target: Target,
    say: Callable[[str], None], stopping: Callable[[], bool], seconds: float = math.inf,
) -> bool:  # fmt: skip
    """Show a daemon's streams until `stopping`, or for `seconds`; → whether there was one. `known`:
    more than the streams tell, the slices and the truth.

    Raises:
        SetupError: nothing can be shown, the endpoint is none, or a stream of another version.
    """
    target.check()
    with Streams(endpoint, keys) as streams:
        heard, stage = [], None
        end_s = time.monotonic() + ANSWER_S
        while stage is None and time.monotonic() < end_s and not stopping():
            for message in streams.wait(LOOK_S):
                heard.append(message)
                if message[0] == messages.INFO:
                    stage = from_info(message[1])
        if stage is None:
            if not stopping():
                print(unanswered(endpoint), file=sys.stderr)  # noqa: T201
            return stopping()
        if known is not None and len(known.position_m) != len(stage.position_m):
            raise SetupError(
                f"{endpoint}: its skin has {len(stage.position_m)} taxels, that of the "
                f"configuration {len(known.position_m)}; name the daemon's own"
            )
        stage = known or stage
        stream, line = target.open()
        say(line)
        space, until = Space(stage, stream, is_live=True), _Until(seconds)
        for message in chain(heard, _heard(streams, stopping)):
            if until.over(message):
                break
            space.take(message)
        stream.flush()
    return True


def recorded(
    stage: Stage, recording: Iterator[Message], target: Target, say: Callable[[str], None],
    stopping: Callable[[], bool], seconds: float = math.inf,
) -> None:  # fmt: skip
    """Show a session, or its first `seconds`, as fast as it is replayed; in a browser until
    `stopping`.

    Raises:
        SetupError: nothing can be shown, or the session is damaged.
    """
    target.check()
    stream, line = target.open()
    if not target.save:
        say(line)
    space, until = Space(stage, stream, is_live=False), _Until(seconds)
    for message in recording:
        if stopping() or until.over(message):
            break
        space.take(message)
    stream.flush()
    if until.begun is None:
        raise SetupError("view: the session holds no scan after the idle baseline")
    if target.save:
        stream.disconnect()
        say(line)
    while target.web and not stopping():
        time.sleep(LOOK_S)


class _Until:
    """The end of so many seconds, by the times of the scans."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.begun: float | None = None

    def over(self, message: Message) -> bool:
        t = message[1].get("t", 0.0)
        if message[0] != messages.ESTIMATE or not t:
            return False
        if self.begun is None:
            self.begun = t
        return bool(t - self.begun > self._seconds)


def _heard(streams: Streams, stopping: Callable[[], bool]) -> Iterator[Message]:
    while not stopping():
        yield from streams.wait(LOOK_S)


def _has_screen() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _beside() -> str | None:
    """The viewer of this environment, whether or not its programs are in PATH."""
    path = Path(sys.executable).with_name("rerun")
    return str(path) if path.exists() else None


def _web_address(grpc: str) -> str:
    return f"http://127.0.0.1:9090?url={grpc.replace('0.0.0.0', '127.0.0.1')}"  # noqa: S104
