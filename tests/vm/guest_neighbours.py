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
SPARE_MB = 12  # of what a daemon lets peers hoard before it hangs up on them, a part


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


def hear_more(listener: Listener) -> None:
    heard = listener.estimates

    def hears() -> bool:
        listener.hear()
        return listener.estimates > heard

    until("an estimate", hears)


def use_up_memory(unit: Unit, user: str, endpoint: str) -> float:
    """By a message without end, until the unit has been ended for it and is ready again; → when
    that began, Unix time."""
    restarts, began_s = unit.restarts(), time.time()
    unit.leave_memory(SPARE_MB)
    command = attacker(user, "endless_to_stream", endpoint, 1000, PATIENCE_S)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as attack:
        try:
            until(f"{unit.name} is ended", lambda: unit.restarts() > restarts)
        finally:
            attack.kill()
    unit.wait_restarted(restarts)
    assert "killed by the OOM killer" in unit.journal()
    return began_s


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
        use_up_memory(RELAY, STRANGER, RELAYED)
        hear_more(relayed)
        hear_more(healthy)
    assert healthy.missed == 0
    assert (VCAN0.pid, VCAN0.restarts()) == (pid, restarts)


@check
def a_daemon_that_is_out_of_memory_is_restarted_and_its_recording_is_kept() -> str:
    """The relay goes on, and the next run is recorded as well."""
    users()
    begun = recording()
    RELAY.start()
    relay = RELAY.pid, RELAY.restarts()
    busy = ["cangen", VCAN0.instance, "-g", "20"]  # milliseconds from frame to frame
    with listening(RELAYED) as relayed, subprocess.Popen(busy) as bus:
        try:
            until("a recording", lambda: len(frame_times(begun)) > FRAMES)
            began_s = use_up_memory(VCAN0, MEMBER, STREAM)
            hear_more(relayed)
        finally:
            bus.kill()
    assert (RELAY.pid, RELAY.restarts()) == relay
    RELAY.stop()
    kept = frame_times(begun)
    assert kept[-1] > began_s
    since = recording()
    assert since != begun
    assert (since / session.ABOUT).exists()
    return f"{len(kept)} frames, to {VCAN0.ended_s() - kept[-1]:.1f} s before its end"
