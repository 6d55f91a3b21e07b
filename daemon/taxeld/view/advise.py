"""`taxeld advise`: where to touch next, as a running daemon publishes it."""

import contextlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from taxeld.commands.unanswered import unanswered
from taxeld.stream import messages
from taxeld.view.streams import Subscriber

ANSWER_S = 5.0  # a daemon at rest has told its advice by then
LOOK_S = 0.2  # pause between two looks whether to end
NONE_YET = (
    "no advice comes: set advice.enabled in its configuration; with it there is none while the "
    "skin is touched, or moves"
)


def advise(
    endpoint: str, keys: Path | None, stopping: Callable[[], bool], *, as_json: bool, follow: bool
) -> bool:
    """Print the advice on the present belief, and with `follow` each later one until `stopping`; →
    False where there was none.

    Raises:
        SetupError: the endpoint is none, a key cannot be used, or a stream of another version.
    """
    heard, until_s = False, time.monotonic() + ANSWER_S
    before: list[dict[str, Any]] | None = None
    topics = messages.INFO, messages.ADVICE
    with contextlib.closing(Subscriber(endpoint, keys, topics)) as streams:
        while (follow and heard) or time.monotonic() < until_s:
            for topic, message in streams.wait(LOOK_S):
                heard = True
                if topic == messages.INFO or message["approaches"] == before:
                    continue
                before = message["approaches"]
                _say(json.dumps(message) if as_json else "\n".join(lines(message)))
                if not follow:
                    return True
            if stopping():
                return True
    print(f"{endpoint}: {NONE_YET}" if heard else unanswered(endpoint), file=sys.stderr)  # noqa: T201
    return False


def lines(message: dict[str, Any]) -> Iterator[str]:
    """Lines for a person, from the map of `/taxeld/advice`."""
    free = ", best first:" if message["approaches"] else ": no approach is free"
    says = ": no touch would tell more" if message["enough"] else free
    yield f"after {message['contacts']} contacts{says}"
    for number, one in enumerate(message["approaches"], 1):
        of = f" with {one['name']}" if one["name"] else ""
        yield f"{number}. from {_pose(one['before'])}{of}"
        along, deep = math.degrees(one["direction"]), 1e3 * one["depth_m"]
        yield f"   along {along:.0f}°, until {_place(one['until'])} at most"
        yield f"   contact expected at {_place(one['at'])}; then press {deep:.1f} mm"
        chances = f"touches {one['p_touch']:.0%}, sure afterwards {one['p_sure']:.0%}"
        yield f"   {chances}, gain {1e3 * one['gain']:.1f} mm"


def _place(pose: dict[str, float]) -> str:
    return f"x {pose['x']:.4f} m, y {pose['y']:.4f} m"


def _pose(pose: dict[str, float]) -> str:
    return f"{_place(pose)}, yaw {pose['theta']:.3f} rad"


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201
