"""`taxeld view`: a daemon's streams or a session in Rerun's viewer, or in a file."""

import contextlib
import math
import os
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path

import rerun as rr

from taxeld.commands import running
from taxeld.commands.replay import Replay
from taxeld.commands.running import Message
from taxeld.errors import SetupError, WorkError
from taxeld.source import session
from taxeld.stream import messages, topics
from taxeld.view.picture import DRAWN, Picture

ANSWER_S = 5.0  # a running daemon has said who it is by then
PAUSE: Message = b"", {}  # nothing came
LOOK_S = 0.2  # pause between two looks whether to end
PARTICLES_S = 0.05  # between two clouds of particles, as the daemon sends them
VIEWER = str(Path(rr.__file__).parents[1] / "rerun_cli" / "rerun")
# It reads its standard input, and no other machine can reach it
OPTIONS = "-", "--bind=127.0.0.1", "--port=auto", "--memory-limit=2GB", "--hide-welcome-screen"

Ends = Callable[[], bool]


def run(source: str, save: Path | None, seconds: float, ends: Ends) -> str:
    """Show the daemon or session that `source` names, or `save` what it shows: the first `seconds`
    of scans, until `ends`; → a line on it.

    Raises:
        SetupError: the source, the screen or the file cannot be used.
        WorkError: no daemon answers.
    """
    if not seconds > 0.0:
        raise SetupError("--seconds: must be more than 0")
    if source and "://" not in source and Path(source).suffix != ".toml":
        picture, heard = recorded(Path(source))
    else:
        picture, heard = Picture(), live(running.endpoint_of(source, running.PUBLISH), ends)
        heard = chain([next(heard, PAUSE)], heard)  # no window or file before a daemon answers
    heard = begun(heard, seconds, ends)
    if save is None:
        show(picture, heard, ends)
        return "the window is closed"
    write(picture, heard, save)
    return f"written: {save}; see it with: rerun {save}"


def live(endpoint: str, ends: Ends) -> Iterator[Message]:
    """What a daemon publishes, and pauses.

    Raises:
        SetupError: the endpoint is none, or a key cannot be used.
        WorkError: no daemon answers.
    """
    until_s = time.monotonic() + ANSWER_S
    with contextlib.closing(running.Subscriber(endpoint, [topics.INFO, *DRAWN])) as streams:
        while not ends():
            for message in streams.wait(LOOK_S):
                until_s = math.inf
                yield message
            if until_s == math.inf:
                yield PAUSE
            elif time.monotonic() > until_s:
                raise WorkError(running.unanswered(endpoint))


def recorded(directory: Path) -> tuple[Picture, Iterator[Message]]:
    """A picture for a session, and what a daemon would have published. Raises SetupError where the
    session, or what its configuration names, cannot be used."""
    replay = Replay(directory)
    known = replay.pipeline.estimator.known if replay.names else []
    scenes = {name: each.model.scene for name, each in zip(replay.names, known, strict=True)}

    def heard() -> Iterator[Message]:
        yield topics.INFO, messages.info(replay.layout, scenes, "")
        next_s = 0.0  # the next cloud of particles is due at this time
        for seq, outcome in enumerate(replay):
            e, felt = outcome.estimate, outcome.activation
            if felt is not None and not outcome.link:
                yield topics.TAXELS, messages.taxels(felt, outcome.sensor, seq)
            if scenes:
                why = replay.why(e)
                yield topics.ESTIMATE, messages.estimate(e, names=replay.names, seq=seq, why=why)
            if scenes and e.contact and not e.t < next_s < e.t + 1.0:
                next_s = e.t + PARTICLES_S
                yield topics.PARTICLES, messages.particles(e.t, seq, *replay.belief)

    return Picture(list(scenes.values()), session.truth(directory)), heard()


def begun(heard: Iterable[Message], seconds: float, ends: Ends) -> Iterator[Message]:
    """The messages of the first `seconds` of scans, until `ends`."""
    begun_s = 0.0
    for topic, message in heard:
        t = message["t"] if topic in DRAWN else 0.0
        begun_s = begun_s or t
        if ends() or t - begun_s > seconds:
            return
        yield topic, message


def write(picture: Picture, heard: Iterable[Message], path: Path) -> None:
    """Draw into an .rrd file. Raises SetupError where it cannot be written."""
    try:
        path.open("ab").close()  # else another thread meets the fault
    except OSError as error:
        raise SetupError(f"--save: cannot write {path} ({error.strerror})") from None
    picture.stream.save(path)
    for topic, message in heard:
        picture.take(topic, message)
    picture.stream.disconnect()


def show(picture: Picture, heard: Iterable[Message], ends: Ends) -> None:
    """Draw in a window until it is closed. Raises SetupError where there is none."""
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SetupError("view: no screen here; use --save FILE, and see it with: rerun FILE")
    drawn = picture.stream.binary_stream()
    os.environ.setdefault("RUST_LOG", "error")  # else the viewer writes its news to this terminal
    with subprocess.Popen([VIEWER, *OPTIONS], stdin=subprocess.PIPE, bufsize=0) as viewer:  # noqa: S603
        assert viewer.stdin is not None  # noqa: S101
        with contextlib.suppress(BrokenPipeError):  # the window has been closed
            for topic, message in heard:
                picture.take(topic, message)
                viewer.stdin.write(drawn.read(flush=False) or b"")
                if viewer.poll() is not None:
                    break
            viewer.stdin.write(drawn.read() or b"")
            viewer.stdin.close()
            while viewer.poll() is None and not ends():
                time.sleep(LOOK_S)
            viewer.terminate()
    drawn.read()  # what is left: the stream's end would wait for it and hold the interpreter
    if viewer.returncode > 0:
        raise SetupError("view: the viewer failed, as it says above; use --save FILE")
