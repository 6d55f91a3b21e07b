"""`taxeld view`: streams or a session in Rerun's viewer, in a browser, or into a file."""

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import rerun as rr

from taxeld.commands.unanswered import unanswered
from taxeld.errors import SetupError
from taxeld.stream import messages
from taxeld.view import viewer
from taxeld.view.live import Streams
from taxeld.view.recorded import Recording
from taxeld.view.space import Space
from taxeld.view.stage import Message, Stage, from_info

ANSWER_S = 5.0  # in which a daemon that is there has said who it is
LOOK_S = 0.2


@dataclass(frozen=True)
class Shown:
    """Where it is shown, into the file `save`, in a browser or in a window, and how long."""

    save: Path | None = None
    web: bool = False
    seconds: float = math.inf  # from the first scan, by the times of the scans
    stopping: Callable[[], bool] = lambda: False
    say: Callable[[str], None] = print

    def show(self, stage: Stage, heard: Iterable[Message], *, is_live: bool) -> bool:
        """Show all that is heard; → whether there was any of it.

        Raises:
            SetupError: nothing can be shown, or what is heard cannot be used.
        """
        until = _Until(self.seconds)
        with contextlib.ExitStack() as opened:
            stream = rr.RecordingStream("taxeld")
            window = None
            if self.save is not None:
                self._save(stream, self.save)
            else:
                window = opened.enter_context(viewer.start(web=self.web))
                stream.connect_grpc(window.address)
                self.say(f"open in a browser: {window.page}" if self.web else "the viewer is open")
            space = Space(stage, stream, is_live=is_live)
            for message in heard:
                if self.stopping() or until.over(message) or (window and window.is_gone):
                    break
                space.take(message)
            stream.flush()
            stream.disconnect()
            while self.web and not self.stopping():  # the browser asks us
                time.sleep(LOOK_S)
        if self.save is not None and until.begun is not None:
            self.say(f"written: {self.save}; see it with: rerun {self.save}")
        return until.begun is not None

    @staticmethod
    def _save(stream: rr.RecordingStream, path: Path) -> None:
        try:
            path.open("ab").close()  # else the fault is told by another thread
        except OSError as error:
            raise SetupError(f"--save: cannot write {path} ({error.strerror})") from None
        stream.save(path)


def live(endpoint: str, keys: Path | None, known: Stage | None, shown: Shown) -> bool:
    """Show a daemon's streams; → whether there was one. `known`: more than the streams tell, the
    slices and the truth.

    Raises:
        SetupError: nothing can be shown, the endpoint is none, or a stream of another version.
    """
    with Streams(endpoint, keys) as streams:
        heard: list[Message] = []
        stage = None
        end_s = time.monotonic() + ANSWER_S
        while stage is None and time.monotonic() < end_s and not shown.stopping():
            for message in streams.wait(LOOK_S):
                heard.append(message)
                stage = from_info(message[1]) if message[0] == messages.INFO else stage
        if stage is None:
            if not shown.stopping():
                print(unanswered(endpoint), file=sys.stderr)  # noqa: T201
            return shown.stopping()
        if known is not None and len(known.position_m) != len(stage.position_m):
            raise SetupError(
                f"{endpoint}: its skin has {len(stage.position_m)} taxels, that of the "
                f"configuration {len(known.position_m)}; name the daemon's own"
            )
        shown.show(known or stage, chain(heard, _heard(streams, shown.stopping)), is_live=True)
    return True


def recorded(directory: Path, shown: Shown) -> None:
    """Show a session, as fast as it is replayed.

    Raises:
        SetupError: nothing can be shown, or the session cannot be used, or holds nothing.
    """
    recording = Recording(directory)
    if not shown.show(recording.stage, recording, is_live=False) and not shown.stopping():
        raise SetupError(f"{directory}: holds no scan to show")


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
