"""`taxeld view`: the streams or a session in Rerun's viewer, in a browser, or into a file."""

import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rerun as rr
import rerun_bindings

from taxeld.commands.unanswered import unanswered
from taxeld.errors import SetupError
from taxeld.model.scene import Scene
from taxeld.stream import messages
from taxeld.view.picture import Picture
from taxeld.view.stage import Stage, from_info
from taxeld.view.streams import Message, Subscriber

ANSWER_S = 5.0  # a running daemon has said who it is by then
LOOK_S = 0.2  # pause between two looks whether to end
HOST = "127.0.0.1"
PORT, WEB_PORT = 9876, 9090  # Rerun's own; free ones where these are taken
MEMORY = "2GB"  # limit for the viewer, which then drops the oldest data
VIEWER = Path(rr.__file__).parents[1] / "rerun_cli" / "rerun"


@dataclass(frozen=True)
class Destination:
    """Where a picture goes, and for how long: into the file `save`, to a browser or a window."""

    save: Path | None
    web: bool
    seconds: float  # duration from the first scan, by the times of the scans
    stopping: Callable[[], bool]


def live(endpoint: str, keys: Path | None, scenes: Sequence[Scene], target: Destination) -> bool:
    """Show a daemon's streams; → whether there was one. `scenes`: the objects, where more of them
    is known than the outlines that the streams have.

    Raises:
        SetupError: nothing can be shown, the endpoint is none, or a stream of another version.
    """
    with contextlib.closing(Subscriber(endpoint, keys)) as streams:
        info = _first_info(streams, target.stopping)
        if info:
            show(from_info(info, scenes), _heard(streams), target)
        elif not target.stopping():
            print(unanswered(endpoint), file=sys.stderr)  # noqa: T201
            return False
    return True


def show(stage: Stage, heard: Iterable[Message], target: Destination) -> bool:
    """Draw all messages; → whether there was a scan.

    Raises:
        SetupError: nothing can be shown, or the messages cannot be used.
    """
    stream, viewer = rr.RecordingStream("taxeld"), 0
    if target.save is None:
        viewer = _open_viewer(stream, web=target.web)
    else:
        _save(stream, target.save)
    begun_s, leading = 0.0, messages.ESTIMATE if stage.things else messages.TAXELS
    try:
        picture = Picture(stage, stream)
        for topic, message in heard:
            if target.stopping() or _has_ended(viewer):
                break
            if topic == leading and message["t"]:
                begun_s = begun_s or message["t"]
                if message["t"] - begun_s > target.seconds:
                    break
            picture.take(topic, message)
        stream.flush()
        stream.disconnect()
        if begun_s and target.save is not None:
            _say(f"written: {target.save}; see it with: rerun {target.save}")
        elif begun_s and not stage.is_live:
            _say("the session is shown")
        while target.web and not target.stopping() and not _has_ended(viewer):
            time.sleep(LOOK_S)  # the browser asks the viewer's process
    finally:
        if target.web and not _has_ended(viewer):  # a window stays
            os.kill(viewer, signal.SIGTERM)
            os.waitpid(viewer, 0)
    return bool(begun_s)


def _first_info(streams: Subscriber, stopping: Callable[[], bool]) -> dict[str, Any]:
    """The daemon's first `/taxeld/info`; empty where none comes."""
    end_s = time.monotonic() + ANSWER_S
    while time.monotonic() < end_s and not stopping():
        for topic, message in streams.wait(LOOK_S):
            if topic == messages.INFO:
                return message
    return {}


def _heard(streams: Subscriber) -> Iterator[Message]:
    while True:
        yield from streams.wait(LOOK_S)
        yield b"", {}  # no message: the reader looks whether to end


def _open_viewer(stream: rr.RecordingStream, *, web: bool) -> int:
    """Start a viewer that only this machine can reach, and send it the stream; → its process.

    `rr.spawn` has no argument for the address, so the function beneath it is called.
    """
    if not web and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SetupError("view: no screen here; use --save FILE, or --web for a browser")
    port, web_port = _free(PORT), _free(WEB_PORT)
    serving = ["--serve-web", f"--web-viewer-port={web_port}"] if web else []
    started = rerun_bindings.spawn(
        port=port,
        memory_limit=MEMORY,
        hide_welcome_screen=True,
        executable_path=str(VIEWER),
        extra_args=[f"--bind={HOST}", *serving],
        extra_env=[("RERUN_APP_ONLY", "true"), ("RUST_LOG", "error")],
    )
    viewer = started or 0
    if _has_ended(viewer):
        raise SetupError("view: the viewer ended at once; use --save FILE, or --web for a browser")
    address = f"rerun+http://{HOST}:{port}/proxy"
    stream.connect_grpc(address)
    page = f"open in a browser: http://{HOST}:{web_port}?url={address}"
    _say(page if web else "the viewer is open")
    return viewer


def _free(port: int) -> int:
    """The port, or another where it is taken."""
    with socket.socket() as probe:
        try:
            probe.bind((HOST, port))
        except OSError:
            probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def _has_ended(viewer: int) -> bool:
    """Whether the process of a viewer has ended; False of 0, which is none."""
    try:
        return viewer > 0 and os.waitpid(viewer, os.WNOHANG)[0] == viewer
    except ChildProcessError:  # it was asked before
        return True


def _save(stream: rr.RecordingStream, path: Path) -> None:
    try:
        path.open("ab").close()  # else another thread meets the fault
    except OSError as error:
        raise SetupError(f"--save: cannot write {path} ({error.strerror})") from None
    stream.save(path)


def _say(line: str) -> None:
    print(line, flush=True)  # noqa: T201
