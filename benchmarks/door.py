"""What peers can do to a running daemon: one whose door is killed, and one for each attack.

    python benchmarks/door.py [--seconds 10] [--killed-s 600] [--only TEXT] [--json FILE]

Each row has a daemon of its own, which records a virtual skin that is touched all the time, an
honest subscriber, and a client that asks for `status` and waits for 2 s. `--killed-s` is of the row
in which the door is killed for long; 0 leaves it out.
"""

import argparse
import contextlib
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import zmq
from zmq.auth import create_certificates, load_certificate

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.door import attacks
from tests.door.stand import free_port, program, resident_bytes
from tests.system.touched import Touched, touched

KILL_S, ASK_S, LOOK_S, STATUS_S = 1.0, 2.0, 0.1, 2.0


@dataclass
class Row:
    """One daemon."""

    case: str
    overruns_per_1000: float = 0.0  # passes of the loop whose own CPU time was longer than a period
    scans: int = 0  # that the skin has sent
    missed: int = 0  # of these, without an estimate in the recording's replay
    read: int = 0  # of these, by the loop
    loop_mb: float = 0.0  # resident, at most
    door_mb: float = 0.0
    door_starts: int = 0
    heard: int = 0  # estimates, by the honest subscriber
    gaps: int = 0  # estimates between two that it heard
    reconnected: int = 0
    answered: str = ""  # of the questions for `status`, within 2 s


class Attack(NamedTuple):
    """`arguments`: with names of `Place`."""

    name: str
    program: str
    arguments: str
    copies: int = 1
    needs: str = ""  # robot, or keys


class Place:
    """A directory with a daemon, and what it is told beside its skin."""

    def __init__(self, directory: Path, needs: str) -> None:
        self.path, self.settings = directory, ""
        directory.chmod(0o755)
        port = str(free_port())
        tcp = f"tcp://127.0.0.1:{port}"
        anywhere = tcp.replace("127.0.0.1", "0.0.0.0")  # noqa: S104  (loopback takes no keys)
        self.names = {"path": str(directory), "port": port, "tcp": tcp, "key": ""}
        if needs == "robot":
            self.settings = f'[sensor_pose]\nendpoint = "{tcp}"\n'
        elif needs == "keys":
            keys = directory / "keys"
            (keys / "clients").mkdir(parents=True)
            create_certificates(keys, "server")
            create_certificates(keys / "clients", "client")
            (keys / "server.key_secret").chmod(0o600)
            self.names["key"] = load_certificate(keys / "server.key")[0].decode()
            self.settings = f'[curve]\ndirectory = "{keys}"\n'
            self.settings += f'[relay]\npublish = ["{anywhere}"]\n'


STREAM, CONTROL = "{path}/stream", "{path}/control"
ATTACKS = [
    Attack("subscribers shut their reading side", attacks.SHUT, STREAM, 2),
    Attack("a false robot sends without end", attacks.ENDLESS_POSE, "{port}", needs="robot"),
    Attack("a robot with large and odd messages", attacks.CARELESS_ROBOT, "{tcp}", needs="robot"),
    Attack("descriptors that linger", attacks.LINGER, STREAM, 3),
    Attack("handshakes with strange keys", attacks.STRANGE_KEYS, "{key} {tcp}", 2, "keys"),
    Attack("a message without end", attacks.HOARD, STREAM, 2),
    Attack("every place of control, another user", attacks.PLACES, CONTROL),
    Attack("every place of the stream, another user", attacks.PLACES, STREAM),
    Attack("requests without end", attacks.REQUESTS, f"ipc://{CONTROL}", 4),
    Attack("clients with correlated requests", attacks.CORRELATED, f"ipc://{CONTROL}", 2),
    Attack("a slow subscriber", attacks.SLOW, f"ipc://{STREAM}", 2),
    Attack("asking for the description again", attacks.ASK_AGAIN, STREAM),
]


class Honest:
    """A subscriber as a client would write it."""

    def __init__(self, opened: contextlib.ExitStack, endpoint: str) -> None:
        context = opened.enter_context(zmq.Context())
        self._socket = opened.enter_context(context.socket(zmq.SUB))
        self._socket.linger = self._socket.rcvhwm = 0
        self._socket.subscribe(b"/taxeld/estimate")
        self._events = opened.enter_context(self._socket.get_monitor_socket(zmq.EVENT_CONNECTED))
        self._events.linger = 0
        self._socket.connect(endpoint)
        self._seq, self.heard, self.gaps, self.reconnected = 0, 0, 0, -1

    def hear(self) -> None:
        while self._events.poll(0):
            self._events.recv_multipart()
            self.reconnected += 1
        while self._socket.poll(0):
            seq = msgpack.unpackb(self._socket.recv_multipart()[1])["seq"]
            self.gaps += max(seq - self._seq - 1, 0) if self.heard else 0
            self._seq, self.heard = seq, self.heard + 1


def resident_mb(pid: int) -> float:
    with contextlib.suppress(OSError):
        return round(resident_bytes(pid) / 2**20, 1)
    return 0.0  # it has ended


def suffer(case: str, seconds: float, attack: Attack | None, kills: bool) -> Row:
    """One row."""
    row = Row(case)
    with contextlib.ExitStack() as opened:
        directory = Path(opened.enter_context(tempfile.TemporaryDirectory()))
        place = Place(directory, attack.needs if attack else "")
        daemon = opened.enter_context(touched(directory, place.settings))
        daemon.until_running()
        (directory / "stream").chmod(0o666)  # so that another user may try
        (directory / "control").chmod(0o666)
        honest = Honest(opened, daemon.stream)
        before = daemon.health()
        with contextlib.ExitStack() as attackers:
            for _ in range(attack.copies if attack else 0):
                arguments = attack.arguments.format(**place.names).split()
                attackers.enter_context(program(attack.program, *arguments))
            _watch(daemon, honest, row, seconds, kills=kills)
            after = daemon.health()
        own, passes = (after["loop"][n] - before["loop"][n] for n in ("own_overruns", "ticks"))
        row.overruns_per_1000 = round(1e3 * own / max(passes, 1), 2)
        row.door_starts = after["door"]["starts"]
        row.heard, row.gaps, row.reconnected = honest.heard, honest.gaps, honest.reconnected
        row.scans = daemon.stop()
        row.read = daemon.last["loop"]["scans"]
        row.missed = row.scans - len(daemon.replay())
    return row


def _watch(daemon: Touched, honest: Honest, row: Row, seconds: float, *, kills: bool) -> None:
    now_s = time.monotonic()
    until_s, kill_s, ask_s = now_s + seconds, now_s + KILL_S, now_s + ASK_S / 2
    answers: list[bool] = []
    while (now_s := time.monotonic()) < until_s:
        honest.hear()
        row.loop_mb = max(row.loop_mb, resident_mb(daemon.pid))
        row.door_mb = max(row.door_mb, resident_mb(daemon.door()))
        if kills and now_s >= kill_s:
            kill_s = now_s + KILL_S
            daemon.kill_door()
        if now_s >= ask_s:
            ask_s = now_s + ASK_S
            answers.append(daemon.status(STATUS_S) is not None)
        time.sleep(LOOK_S)
    row.answered = f"{sum(answers)}/{len(answers)}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="each row")
    parser.add_argument("--killed-s", type=float, default=600.0)
    parser.add_argument("--only", default="", help="rows whose names hold this")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    cases: list[tuple[str, float, Attack | None, bool]] = [
        ("undisturbed", args.seconds, None, False),
        ("door killed each second", args.seconds, None, True),
        *((attack.name, args.seconds, attack, False) for attack in ATTACKS),
        ("door killed each second, for long", args.killed_s, None, True),
    ]
    names = [f.name for f in fields(Row)]
    print(f"{names[0]:42s}  {'  '.join(names[1:])}", flush=True)
    found: list[dict[str, Any]] = []
    for case in cases:
        if args.only not in case[0] or not case[1]:
            continue
        found.append(asdict(suffer(*case)))
        figures = "  ".join(f"{found[-1][name]!s:>{len(name)}}" for name in names[1:])
        print(f"{case[0]:42s}  {figures}", flush=True)
        if args.json:
            args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return int(any(row["missed"] for row in found))


if __name__ == "__main__":
    sys.exit(main())
