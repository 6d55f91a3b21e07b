"""`taxeld view`: streams or a session in Rerun's viewer, in a browser, or into a file."""

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, takewhile
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
DRAWN_S = 0.25  # between two drawings of a session that is replayed: its rows go together


@dataclass(frozen=True)
class Shown:
    """Where it is shown, into the file `save`, in a browser or in a window, and how long."""

    save: Path | None = None
    web: bool = False
    seconds: float = math.inf  # from the first scan, by the times of the scans
    stopping: Callable[[], bool] = lambda: False
    say: Callable[[str], None] = print

    def show(self, stage: Stage, looks: Iterable[list[Message]], *, is_live: bool) -> bool:
        """Show all that is heard, look by look; → whether there was any of it.

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
            for look in looks:
                for message in takewhile(until.holds, look):
                    space.take(message)
                space.flush()
                if until.is_over or self.stopping() or (window and window.is_gone):
                    break
            stream.flush()
            stream.disconnect()
            if window is not None and not is_live:
                self.say(f"{until.shown_s:.0f} s of the session are shown")
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
        shown.show(known or stage, chain([heard], _looks(streams, shown.stopping)), is_live=True)
    return True


def recorded(directory: Path, shown: Shown) -> None:
    """Show a session from its first scan on, as fast as it is replayed.

    Raises:
        SetupError: nothing can be shown, or the session cannot be used, or holds nothing.
    """
    recording = Recording(directory)
    shows = shown.show(recording.stage, _together(recording), is_live=False)
    if not shows and not shown.stopping():
        raise SetupError(f"{directory}: holds no scan to show")


class _Until:
    """The end of so many seconds, by the times of the scans."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.begun: float | None = None
        self.shown_s = 0.0
        self.is_over = False

    def holds(self, message: Message) -> bool:
        """Whether the message comes before the end."""
        t = message[1].get("t", 0.0)
        if message[0] == messages.ESTIMATE and t:
            self.begun = t if self.begun is None else self.begun
            self.is_over |= t - self.begun > self._seconds
            self.shown_s = self.shown_s if self.is_over else t - self.begun
        return not self.is_over


def _looks(streams: Streams, stopping: Callable[[], bool]) -> Iterator[list[Message]]:
    while not stopping():
        yield list(streams.wait(LOOK_S))


def _together(replayed: Iterable[Message]) -> Iterator[list[Message]]:
    """What is replayed within `DRAWN_S`."""
    look: list[Message] = []
    until_s = time.monotonic() + DRAWN_S
    for message in replayed:
        look.append(message)
        if time.monotonic() >= until_s:
            yield look
            look, until_s = [], time.monotonic() + DRAWN_S
    yield look
