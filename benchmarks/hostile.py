"""What a neighbour can do to a running daemon: attacks, beside a healthy subscriber and a client.

    python benchmarks/hostile.py [--short] [--only TEXT] [--json FILE]
                                 [--daemon COMMAND] [--path PYTHONPATH]

A virtual skin that is touched sends twenty scans a second, a robot a hundred poses. Attackers are
processes of their own (attacks.py) at the daemon's ipc sockets and at the relay's TCP, or robots
that err, or one who sends signals. As root all of it is in a network namespace of its own.
`--daemon` and `--path` are of the daemon and the relay alone, so that another version can be
attacked as well; one without a relay serves TCP itself.
"""

import argparse
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import msgpack
import zmq

import hostile_watch as watch
from hostile_world import FAR_M, SHORT_S, Attack, World
from taxeld.stream import messages

IN_NAMESPACE = "TAXELD_HOSTILE_NAMESPACE"
LATE_S = 2.5  # timers of connections that are gone may act so late
TRIES = 3  # where the machine was too busy for those who watch
SIGNALS = signal.SIGHUP, signal.SIGUSR1, signal.SIGALRM


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--short", action="store_true", help=f"each attack for {SHORT_S:g} s at most"
    )
    parser.add_argument("--only", default="", help="attacks whose names hold this")
    parser.add_argument("--daemon", default=f"{sys.executable} -m taxeld.cli")
    parser.add_argument("--path", default=os.environ.get("PYTHONPATH", ""))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if IN_NAMESPACE not in os.environ and _may_have_a_namespace():
        environ = {**os.environ, IN_NAMESPACE: "1"}
        os.execvpe("unshare", ["unshare", "--net", sys.executable, *sys.argv], environ)  # noqa: S606
    if IN_NAMESPACE in os.environ:
        subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    found = rows(args.short, args.only, shlex.split(args.daemon), args.path)
    print(watch.HEADER)
    for row in found:
        print(row.line(), flush=True)
    if args.json:
        text = json.dumps([asdict(row) for row in found], indent=1)
        args.json.write_text(text + "\n", encoding="utf-8")
    return 0


def _may_have_a_namespace() -> bool:
    """Whether this user may have a network of their own; else it is the machine's loopback."""
    if not shutil.which("unshare") or not shutil.which("ip"):
        return False
    trial = ["unshare", "--net", "ip", "link", "set", "lo", "up"]
    return subprocess.run(trial, capture_output=True, check=False).returncode == 0


def rows(short: bool, only: str, command: list[str], path: str) -> list[watch.Row]:
    """Every attack, on one daemon as long as it lives, and on another after that."""
    found = []
    with ExitStack() as stack:
        world = World(stack, command, path)
        for attack in ATTACKS:
            if only not in attack.name or (short and not attack.in_short):
                continue
            for _ in range(TRIES):
                row = world.suffer(attack, short)
                if row is None or not row.is_disturbed:
                    break
            if row is not None:
                print(row.line(), file=sys.stderr, flush=True)
                found.append(row)
    return found


def _pose(world: World, topic: bytes, later_s: float = 0.0, x: float = 0.0) -> None:
    wall_s = time.time()
    body = msgpack.packb({"t": wall_s + later_s, "x": x, "y": 0.0, "theta": 0.0})
    world.poses.send_multipart((topic, body, b"%.6f" % wall_s), zmq.NOBLOCK)


def of_another_arm(world: World) -> None:
    _pose(world, messages.SENSOR_POSE + b"_left_arm", x=0.3)


def far_away(world: World) -> None:
    _pose(world, messages.SENSOR_POSE, x=FAR_M)


def lost(world: World) -> None:
    """All of the robot's own poses are far away, for as long as this is called."""
    world.voice.far_until_s = time.monotonic() + 0.1


def from_the_future(world: World) -> None:
    _pose(world, messages.SENSOR_POSE, later_s=3600.0)


def of_many_frames(world: World) -> None:
    frames = [messages.SENSOR_POSE, *[b"x"] * 5000]
    world.poses.send_multipart(frames, zmq.NOBLOCK)


def signals(world: World) -> None:
    """What a terminal, a script or a timer would send, once each."""
    if world.daemon is not None:
        world.daemon.signal_once(*SIGNALS)


def signals_to_relay(world: World) -> None:
    if world.relay is not None:
        world.relay.signal_once(*SIGNALS)


def remove_sockets(world: World) -> None:
    """Whoever may write in the directory, or a cleaner of /run; once."""
    if world.daemon is not None and world.daemon.is_first("removal"):
        for name in ("stream", "control"):
            (world.place / name).unlink(missing_ok=True)


ATTACKS = [
    Attack("nothing", seconds=3.0, in_short=False),
    Attack("subscribe and leave, tcp", "subscribe_and_leave", "tcp stream", 400, 40, late_s=LATE_S),
    Attack("subscribe and leave, ipc", "subscribe_and_leave", "stream", 400, 40, late_s=LATE_S),
    Attack("ask and leave, ipc", "ask_and_leave", "control", 400, 40, late_s=LATE_S),
    Attack(
        "ask and leave, tcp", "ask_and_leave", "tcp control", 400, 40, late_s=LATE_S, in_short=False
    ),
    Attack(
        "a flood that exits, ipc", "flood_and_exit", "control", 200_000, 20_000, 2.0, late_s=LATE_S
    ),
    Attack(
        "a flood that exits, tcp",
        "flood_and_exit",
        "tcp control",
        200_000,
        0,
        late_s=LATE_S,
        in_short=False,
    ),
    Attack("idle connections, tcp", "idle", "tcp stream", 1100, 100, limits_files=True),
    Attack("1 500 idle connections, tcp", "idle", "tcp stream", 1500, in_short=False),
    Attack("idle connections, ipc", "idle", "stream", 400, 100, limits_files=True),
    Attack("a crowd, tcp", "crowd", "tcp stream", 10_000, 200, seconds=60.0, late_s=LATE_S),
    Attack("unique subscriptions, tcp", "unique_subscriptions", "tcp stream", 100, 20),
    Attack("unique subscriptions, ipc", "unique_subscriptions", "stream", 100, 20),
    Attack("endless message, tcp", "endless_to_stream", "tcp stream", 4000, 400),
    Attack("endless message, ipc", "endless_to_stream", "stream", 4000, 400),
    Attack("endless request, ipc", "endless_to_control", "control", 4000, 400),
    Attack("endless request, tcp", "endless_to_control", "tcp control", 4000, in_short=False),
    Attack("a stranger unsubscribes, ipc", "stranger", "stream", 40, 8),
    Attack("a stranger unsubscribes, tcp", "stranger", "tcp stream", 40, in_short=False),
    Attack("a request of many frames, ipc", "many_frames", "control", 200_000, 20_000),
    Attack("poses of another arm", seconds=3.0, act=of_another_arm),
    Attack("poses far away, some", seconds=3.0, act=far_away),
    Attack("poses far away, all", act=lost, late_s=LATE_S),
    Attack("poses from the future", seconds=3.0, act=from_the_future),
    Attack("poses of 5 000 frames", seconds=3.0, act=of_many_frames),
    Attack("a reader tares in a loop", "tare", "asking", 200, 30),
    Attack("socket files removed", seconds=1.0, act=remove_sockets),
    Attack("signals to the daemon", seconds=1.0, act=signals),
    Attack("signals to the relay", seconds=1.0, act=signals_to_relay),
]


if __name__ == "__main__":
    sys.exit(main())
