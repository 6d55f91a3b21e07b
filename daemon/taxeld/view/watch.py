"""`taxeld watch`: a daemon's streams as one page in a terminal, refreshed in place."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.live import Live

from taxeld.commands.unanswered import unanswered
from taxeld.errors import SetupError
from taxeld.view.live import Streams
from taxeld.view.terminal import SILENT_S, Page

REFRESH_S = 0.1
LOOK_S = 1.0  # between looks at why nothing comes


def watch(endpoint: str, keys: Path | None, stopping: Callable[[], bool]) -> None:
    """Show the page until `stopping`; waits for a daemon that is not there, or not there any more.

    Raises:
        SetupError: there is no terminal, the endpoint is none, or a stream of another version.
    """
    if not sys.stdout.isatty():
        raise SetupError(
            "watch: needs a terminal to draw on; 'taxeld status' prints lines, and "
            "examples/clients/subscribe.py reads the streams"
        )
    page, looked_s = Page(endpoint), float("-inf")
    console = Console()
    with (
        Streams(endpoint, keys) as streams,
        Live(console=console, screen=True, auto_refresh=False) as live,
    ):
        while not stopping():
            end_s = time.monotonic() + REFRESH_S
            while (left_s := end_s - time.monotonic()) > 0.0:
                for message in streams.wait(left_s):
                    page.take(message, time.monotonic())
            now_s = time.monotonic()
            if now_s - page.heard_s > SILENT_S and now_s - looked_s > LOOK_S:
                page.waits, looked_s = unanswered(endpoint), now_s
            live.update(page.render(now_s), refresh=True)
