"""`taxeld view`: streams or a session in Rerun's viewer, in a browser, or into a file."""

import contextlib
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
from taxeld.view.live import Streams
from taxeld.view.picture import Picture
from taxeld.view.recorded import Recording
from taxeld.view.stage import Message, Stage, from_info
from taxeld.view.viewer import Viewer

ANSWER_S = 5.0  # in which a daemon that is there has said who it is
LOOK_S = 0.2  # between looks whether to end


@dataclass(frozen=True)
class Shown:
    """Where the picture goes: into the file `save`, to a browser or into a window; and how long."""

    save: Path | None
    web: bool
    seconds: float  # from the first scan, by the times of the scans
    stopping: Callable[[], bool]

    def show(self, stage: Stage, heard: Iterable[Message], *, is_live: bool) -> bool:
        """Draw all that is heard; → whether there was a scan.

        Raises:
            SetupError: nothing can be shown, or the messages cannot be used.
        """
        stream, window = rr.RecordingStream("taxeld"), None
        if self.save is None:
            window = Viewer(web=self.web)
            stream.connect_grpc(window.address)
            _say(f"open in a browser: {window.page}" if self.web else "the viewer is open")
        else:
            _save(stream, self.save)
        try:
            begun = self._draw(Picture(stage, stream, is_live=is_live), heard, window)
            stream.flush()
            stream.disconnect()
            if begun and self.save is not None:
                _say(f"written: {self.save}; see it with: rerun {self.save}")
            elif begun and not is_live:
                _say("the session is shown")
            while self.web and not self.stopping():  # the browser asks us
                time.sleep(LOOK_S)
        finally:
            if window is not None and self.web:  # a window stays
                window.close()
        return begun

    def _draw(self, picture: Picture, heard: Iterable[Message], window: Viewer | None) -> bool:
        begun_s = None
        for topic, message in heard:
            if self.stopping() or (window is not None and window.is_gone):
                break
            if topic == messages.ESTIMATE and message["t"]:
                begun_s = begun_s or message["t"]
                if message["t"] - begun_s > self.seconds:
                    break
            picture.take(topic, message)
        return begun_s is not None


def live(endpoint: str, keys: Path | None, known: Stage | None, shown: Shown) -> bool:
    """Show a daemon's streams; → whether there was one. `known`: more than the streams tell, the
    slices and the truth.

    Raises:
        SetupError: nothing can be shown, the endpoint is none, or a stream of another version.
    """
    with contextlib.closing(Streams(endpoint, keys)) as streams:
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
        shown.show(known or stage, chain(heard, _heard(streams)), is_live=True)
    return True


def recorded(directory: Path, shown: Shown) -> None:
    """Show a session from its first scan on, as fast as it is replayed.

    Raises:
        SetupError: nothing can be shown, or the session cannot be used, or holds nothing.
    """
    recording = Recording(directory)
    if not shown.show(recording.stage, recording, is_live=False) and not shown.stopping():
        raise SetupError(f"{directory}: holds no scan to show")


def _heard(streams: Streams) -> Iterator[Message]:
    while True:
        yield from streams.wait(LOOK_S)
        yield b"", {}  # without a topic, so that its reader looks whether to end


def _save(stream: rr.RecordingStream, path: Path) -> None:
    try:
        path.open("ab").close()  # else the fault is told by another thread
    except OSError as error:
        raise SetupError(f"--save: cannot write {path} ({error.strerror})") from None
    stream.save(path)


def _say(line: str) -> None:
    print(line, flush=True)  # noqa: T201
