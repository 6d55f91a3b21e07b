"""The checks of others on the machine: what they may reach, and memory that they use up.

Attackers are those of attacks.py; a healthy subscriber listens beside them.
"""

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgpack
import zmq
from checks import check
from touch import OVER_TCP, PATIENCE_S, VCAN0, frame_times, frames_of, recording, sh, until

from taxeld.config.tables import ControlConfig, PublishConfig
from taxeld.source import session
from taxeld.stream import client, topics

STREAM, CONTROL = PublishConfig().endpoints[0], ControlConfig().endpoint
CHANGER, MEMBER, STRANGER = "changer", "member", "stranger"
USERS = {CHANGER: "-G taxeld,taxeld-control", MEMBER: "-G taxeld", STRANGER: ""}
ASKED = "status", "tare", "reset"
# of an endpoint and a command; ZeroMQ itself would wait for a socket that it may not open
ASKS = f"""
import socket, sys
from taxeld.stream import client
socket.socket(socket.AF_UNIX).connect(sys.argv[1].removeprefix("ipc://"))
answer = client.ask(*sys.argv[1:], timeout_s={PATIENCE_S})
print("done" if answer["ok"] else "refused")
"""
ATTACKS = "subscribe_and_leave", "endless_to_stream", "unique_subscriptions"
ATTACKERS, FLOOD_S = 3, 30  # at once, and for how long
FRAMES = 100  # in a recording that has begun
IDS = iter(range(0x7F0, 0x800))  # of CAN, that no skin has; another one each time
LACKING_MB = 150  # more than the doors have
LATE_S = 3.0  # a recorder writes four times a second, on a quicker processor


class Listener:
    """A healthy subscriber that keeps up."""

    def __init__(self, context: zmq.Context, endpoint: str) -> None:
        self.heard = self.last = 0  # estimates, and the number of the last one
        self._socket = context.socket(zmq.SUB)
        self._socket.linger = 0
        self._socket.rcvhwm = 0  # what is lost is lost on the other side
        self._socket.subscribe(topics.ESTIMATE)
        self._socket.connect(endpoint)

    def hear(self) -> int:
        while self._socket.poll(0):
            self.last = msgpack.unpackb(self._socket.recv_multipart()[1])["seq"]
            self.heard += 1
        return self.heard

    def close(self) -> None:
        self._socket.close()


def as_user(user: str, *command: str) -> list[str]:
    return ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups", "--", *command]


def users() -> None:
    for user, groups in USERS.items():
        sh(f"id -u {user} || useradd {groups} {user}")


def answered(user: str, command: str) -> str:
    """What comes of a command that a user asks for: done, refused, or no socket."""
    asked = subprocess.run(
        as_user(user, sys.executable, "-c", ASKS, CONTROL, command),
        capture_output=True,
        text=True,
        check=False,
    )
    if "PermissionError" in asked.stderr:
        return "no socket"
    assert asked.returncode == 0, asked.stderr
    return asked.stdout.strip()


@contextmanager
def listening(endpoint: str) -> Iterator[Listener]:
    """A healthy subscriber that hears already."""
    with zmq.Context() as context:
        listener = Listener(context, endpoint)
        try:
            until("an estimate", lambda: listener.hear() > 0)
            yield listener
        finally:
            listener.close()


@contextmanager
def ended(command: list[str]) -> Iterator[None]:
    """A process beside, which is ended afterwards."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as beside:
        try:
            yield
        finally:
            beside.kill()


def numbers(where: Path, can_id: int) -> list[int]:
    """Of those frames of an id that a session has."""
    frames = (frame for frame in frames_of(where) if frame.can_id == can_id)
    return [int.from_bytes(frame.data, "little") for frame in frames]


@contextmanager
def undisturbed() -> Iterator[list[int]]:
    """Whatever is done meanwhile, the loop goes on, and records each frame of the bus.

    The frames' numbers are in the list afterwards.
    """
    kept: list[int] = []
    can_id = next(IDS)
    where = recording()
    pid, restarts = VCAN0.pid, VCAN0.restarts()
    with ended(["cangen", VCAN0.instance, "-g10", "-L8", "-Di", f"-I{can_id:X}"]):
        until("a recording", lambda: len(frame_times(where)) > FRAMES)
        yield kept
        before = len(numbers(where, can_id))
        until("more of it", lambda: len(numbers(where, can_id)) > before + FRAMES)
    kept += numbers(where, can_id)
    assert kept == list(range(kept[0], kept[0] + len(kept))), "frames are missing"
    assert (VCAN0.pid, VCAN0.restarts()) == (pid, restarts)


@check
def only_members_hear_and_only_those_of_the_control_group_change() -> None:
    users()
    recording()
    answers = {user: {asked: answered(user, asked) for asked in ASKED} for user in USERS}
    assert answers == {
        CHANGER: dict.fromkeys(ASKED, "done"),
        MEMBER: {"status": "done", "tare": "refused", "reset": "refused"},
        STRANGER: dict.fromkeys(ASKED, "no socket"),
    }


def flooded(user: str, attack: str, endpoint: str, healthy: Sequence[Listener]) -> list[float]:
    """What each of the `healthy` subscribers has lost of the estimates once it hears again [%]."""
    before = [(each.last, each.heard) for each in healthy]
    # the processor's time that nobody else wants: who attacks by TCP has one of his own elsewhere
    command = ["chrt", "--idle", "0", *as_user(user, sys.executable, "/vm/attacks.py")]
    command += [attack, endpoint, f"{FLOOD_S}"]
    with ExitStack() as beside:
        attackers = [
            beside.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
            for _ in range(ATTACKERS)
        ]
        while any(attacker.poll() is None for attacker in attackers):
            for each in healthy:
                each.hear()
            time.sleep(0.05)
        assert all(int(attacker.stdout.read()) for attacker in attackers), attack
    now = [each.heard for each in healthy]
    until("all hear again", lambda: all(e.hear() > n for e, n in zip(healthy, now, strict=True)))
    return [
        100.0 * (1.0 - (each.heard - heard) / (each.last - last))
        for each, (last, heard) in zip(healthy, before, strict=True)
    ]


@check
def floods_over_tcp_cost_members_nothing_and_none_costs_a_frame() -> str:
    """What a flood costs those who use the same door is told. A door may go on with what a flood
    has left, and end by it, so those over TCP come first."""
    users()
    losses = {}
    with undisturbed() as kept, listening(STREAM) as member, listening(OVER_TCP) as over_tcp:
        for attack in ATTACKS:
            own, others = flooded(STRANGER, attack, OVER_TCP, (over_tcp, member))
            losses[f"{attack} over TCP"] = own
            assert not others, f"{attack} over TCP: members lost {others:.1f} %"
        for attack in ATTACKS:
            losses[f"{attack} by members"], _ = flooded(MEMBER, attack, STREAM, (member, over_tcp))
        assert client.ask(CONTROL, "status", timeout_s=PATIENCE_S) is not None
    lost = "; ".join(f"{name}: {own:.0f} % lost" for name, own in losses.items())
    return f"{len(kept)} frames; {lost}"


@check
def a_daemon_that_is_out_of_memory_is_restarted_and_its_recording_is_kept() -> str:
    """By a fault of the loop's own, as no peer has it grow."""
    begun = recording()
    with ended(["cangen", VCAN0.instance, "-g", "20"]):  # milliseconds from frame to frame
        until("a recording", lambda: len(frame_times(begun)) > FRAMES)
        restarts, limited_s = VCAN0.restarts(), time.time()
        VCAN0.leave_memory(-LACKING_MB)
        VCAN0.wait_restarted(restarts)
    assert "killed by the OOM killer" in VCAN0.journal()
    kept = frame_times(begun)
    assert limited_s - kept[-1] < LATE_S
    since = recording()
    assert since != begun
    assert (since / session.ARRIVALS).exists()
    return f"{len(kept)} frames, to {VCAN0.ended_s() - kept[-1]:.1f} s before its end"
