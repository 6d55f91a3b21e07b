"""The checks of others on the machine: what they may reach, and memory that they use up.

Attackers are those of benchmarks/attacks.py, and its healthy subscriber listens beside them.
"""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import zmq
from checks import check
from touch import (
    PATIENCE_S,
    VCAN0,
    Unit,
    frame_times,
    recording,
    sh,
    until,
)

from hostile_watch import Listener
from taxeld.config.tables import ControlConfig, PublishConfig, RelayConfig
from taxeld.source import session
from taxeld.stream import client

STREAM, CONTROL = PublishConfig().endpoints[0], ControlConfig().endpoint
RELAY, RELAYED = Unit("vcan0", "taxeld-relay"), RelayConfig().publish[0]
MEMBER, STRANGER = "member", "stranger"
ATTACKS = (  # connections or MB, at most, and seconds
    ("subscribe_and_leave", STREAM, 120, 4),
    ("ask_and_leave", CONTROL, 120, 4),
    ("endless_to_stream", STREAM, 100, 4),
    ("unique_subscriptions", STREAM, 20, 4),
)
FRAMES = 100  # in a recording that has begun
SPARE_MB = 12  # of what a relay lets peers hoard before it hangs up on them, a part
LATE_S = 3.0  # a recorder writes four times a second, on a quicker processor


def as_user(user: str, *command: str) -> list[str]:
    return ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups", "--", *command]


def attacker(user: str, name: str, endpoint: str, count: int, seconds: float) -> list[str]:
    attack = "/vm/attacks.py", name, endpoint, str(seconds), str(count)
    return as_user(user, sys.executable, *attack)


def users() -> None:
    sh(f"id -u {MEMBER} || useradd -G taxeld {MEMBER}")
    sh(f"id -u {STRANGER} || useradd {STRANGER}")


@contextmanager
def listening(endpoint: str) -> Iterator[Listener]:
    """A healthy subscriber that hears already."""
    with zmq.Context() as context:
        listener = Listener(context, endpoint)
        try:
            hear_more(listener)
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


def hear_more(listener: Listener) -> None:
    """Until an estimate comes that has not come yet."""
    listener.hear()
    heard = listener.estimates

    def hears() -> bool:
        listener.hear()
        return listener.estimates > heard

    until("an estimate", hears)


def wait_out_of_memory(unit: Unit, restarts: int) -> None:
    """Until it has been ended for it, and is ready again."""
    unit.wait_restarted(restarts)
    assert "killed by the OOM killer" in unit.journal()


@check
def a_user_outside_the_group_reaches_no_socket() -> None:
    users()
    recording()
    for endpoint in (STREAM, CONTROL):
        path = endpoint.removeprefix("ipc://")
        connect = f"import socket; socket.socket(socket.AF_UNIX).connect('{path}')"
        refused = {}
        for user in (MEMBER, STRANGER):
            command = as_user(user, sys.executable, "-c", connect)
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            refused[user] = "PermissionError" in done.stderr
        assert refused == {MEMBER: False, STRANGER: True}


@check
def members_of_the_group_who_flood_end_no_daemon_and_cost_no_estimate() -> str:
    users()
    recording()
    pid, restarts = VCAN0.pid, VCAN0.restarts()
    with listening(STREAM) as healthy:
        for attack in ATTACKS:
            done = json.loads(subprocess.check_output(attacker(MEMBER, *attack)))
            assert done["bytes"], attack
            hear_more(healthy)
            with listening(STREAM) as newcomer:
                assert newcomer.estimates
        assert client.ask(CONTROL, "status", timeout_s=PATIENCE_S) is not None
        hear_more(healthy)
    assert healthy.missed == 0
    assert (VCAN0.pid, VCAN0.restarts()) == (pid, restarts)
    return f"{len(ATTACKS)} attacks, {healthy.estimates} estimates"


@check
def a_relay_that_is_out_of_memory_is_restarted_and_the_daemon_misses_nothing() -> None:
    users()
    recording()
    RELAY.start()
    pid, restarts = VCAN0.pid, VCAN0.restarts()
    with listening(STREAM) as healthy, listening(RELAYED) as relayed:
        before = RELAY.restarts()
        RELAY.leave_memory(SPARE_MB)
        endless = attacker(STRANGER, "endless_to_stream", RELAYED, 1000, PATIENCE_S)
        with ended(endless):
            until("it is ended", lambda: RELAY.restarts() > before)
        wait_out_of_memory(RELAY, before)
        hear_more(relayed)
        hear_more(healthy)
    assert healthy.missed == 0
    assert (VCAN0.pid, VCAN0.restarts()) == (pid, restarts)


@check
def a_daemon_that_is_out_of_memory_is_restarted_and_its_recording_is_kept() -> str:
    """By a fault of its own, as no peer has it grow; the relay goes on, and so does the record."""
    begun = recording()
    RELAY.start()
    relay = RELAY.pid, RELAY.restarts()
    busy = ["cangen", VCAN0.instance, "-g", "20"]  # milliseconds from frame to frame
    with listening(RELAYED) as relayed, ended(busy):
        until("a recording", lambda: len(frame_times(begun)) > FRAMES)
        restarts, limited_s = VCAN0.restarts(), time.time()
        VCAN0.leave_memory(-SPARE_MB)
        wait_out_of_memory(VCAN0, restarts)
        hear_more(relayed)
    assert (RELAY.pid, RELAY.restarts()) == relay
    RELAY.stop()
    kept = frame_times(begun)
    assert limited_s - kept[-1] < LATE_S
    since = recording()
    assert since != begun
    assert (since / session.ABOUT).exists()
    return f"{len(kept)} frames, to {VCAN0.ended_s() - kept[-1]:.1f} s before its end"
