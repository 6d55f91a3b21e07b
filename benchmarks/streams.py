"""What subscribers and commands cost the loop: CPU time of its own thread, with and without them.

Clients are processes of their own; what ZeroMQ's thread does for them is not in the figures. A tick
is a tenth as long as the daemon's, its work the same.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import zmq

from fake_time import FakeTime
from taxeld.config import file as config_file
from taxeld.config.tables import Config
from taxeld.estimator.estimate import Estimate
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle
from taxeld.service.loop import Daemon
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.stream import messages
from taxeld.stream.publisher import Publisher
from taxeld_hil.scenario import scenario as scenarios
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import robot
from taxeld_hil.world.world import make_world
from taxeld_protocol import cyskin
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

ROUNDS = 3
SENDS = 2000
TICK_S, REST_S = 0.01, 0.001
SCENARIO = replace(scenarios.load("demo"), contacts=3)

READS = """
import sys, zmq
context, poller = zmq.Context(), zmq.Poller()
for _ in range(int(sys.argv[2])):
    s = context.socket(zmq.SUB)
    s.subscribe(b"")
    s.connect(sys.argv[1] + "/stream")
    poller.register(s)
while True:
    for s, _ in poller.poll():
        s.recv_multipart()
"""
STALLS = """
import sys, time, zmq
s = zmq.Context().socket(zmq.SUB)
s.rcvhwm = 1
s.subscribe(b"")
s.connect(sys.argv[1] + "/stream")
time.sleep(600)
"""
COMMANDS = """
import sys, msgpack, zmq
s = zmq.Context().socket(zmq.REQ)
s.connect(sys.argv[1] + "/control")
while True:
    s.send(msgpack.packb({"cmd": "status"}))
    s.recv()
"""
COMMANDS_FLOOD = """
import sys, msgpack, zmq
s = zmq.Context().socket(zmq.DEALER)
s.connect(sys.argv[1] + "/control")
while True:
    s.send_multipart([b"", msgpack.packb({"cmd": "status"})])
    while s.poll(0):
        s.recv_multipart()
"""
SUBSCRIPTIONS_FLOOD = """
import sys, zmq
s = zmq.Context().socket(zmq.XSUB)
s.connect(sys.argv[1] + "/stream")
n = 0
while True:
    n += 1
    s.send(b"\\x01/taxeld/%d" % n if n % 2 else b"\\x01/taxeld/info")
    while s.poll(0):
        s.recv_multipart()
"""
CLIENTS: dict[str, tuple[str, ...]] = {
    "nobody": (),
    "one subscriber of all": (READS, "1"),
    "50 subscribers of all": (READS, "50"),
    "a stalled subscriber of all": (STALLS,),
    "a client that asks in a loop": (COMMANDS,),
    "a flood of commands": (COMMANDS_FLOOD,),
    "a flood of subscriptions": (SUBSCRIPTIONS_FLOOD,),
}
Row = tuple[str, float, float | None]


def rows() -> list[Row]:
    return [*sending(), *ticking()]


def sending() -> list[Row]:
    """One estimate, made, packed and sent."""
    found: list[Row] = []
    for name, client in CLIENTS.items():
        if client and client[0] not in (READS, STALLS):
            continue
        with tempfile.TemporaryDirectory() as place, zmq.Context() as context:
            publisher = Publisher(context, 100, {})
            publisher.bind((f"ipc://{place}/stream",), "publish.endpoints")
            settings, _, loaded = setting(place)
            ladder = loaded.untimed(settings.filter)
            estimate = Pipeline(settings, loaded.model, ladder).estimate
            with connected(client, place):
                _settle(publisher, bool(client))
                spent = _send_many(publisher, estimate)
            publisher.close()
        found.append((f"an estimate to {name}: CPU us", spent * 1e6, None))
    return found


def ticking() -> list[Row]:
    """The mean tick of a daemon that is touched, beside the same with nobody there."""
    spent: dict[str, list[float]] = {name: [] for name in CLIENTS}
    with tempfile.TemporaryDirectory() as place:
        poses = record(Path(place))
        for _ in range(ROUNDS):
            for name, client in CLIENTS.items():
                spent[name].append(_run(place, poses, client))
    alone = min(spent["nobody"])  # the least is what no neighbour on the machine disturbed
    return [
        ("a tick with nobody there: CPU ms", alone * 1e3, None),
        *(
            (
                f"a tick with {name}, over that",
                min(times) / alone,
                None if "flood" in name else 1.1,
            )
            for name, times in spent.items()
            if name != "nobody"
        ),
    ]


def _send_many(publisher: Publisher, estimate: Estimate) -> float:
    spent = 0.0
    for seq in range(SENDS):
        start = time.thread_time()
        message = messages.estimate(estimate, seq=seq, valid=False, mono_ns=time.monotonic_ns())
        publisher.send(messages.ESTIMATE, message, 1.0)
        spent += time.thread_time() - start
        if seq % 10 == 0:
            time.sleep(10 * REST_S)
    return spent / SENDS


def _settle(publisher: Publisher, somebody: bool) -> None:
    deadline = time.monotonic() + 10.0
    while publisher.wants(messages.ESTIMATE) != somebody and time.monotonic() < deadline:
        publisher.greet(time.monotonic(), time.time())
        time.sleep(0.01)
    time.sleep(0.5)  # for the others of many


@contextmanager
def connected(client: tuple[str, ...], place: str) -> Iterator[None]:
    if not client:
        yield
        return
    program, *more = client
    process = subprocess.Popen([sys.executable, "-c", program, f"ipc://{place}", *more])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def configured(place: str) -> str:
    """A configuration that replays the session in `place`."""
    skin = layouts.load(SCENARIO.layout)
    listed = [[module.sui, module.mask] for module in wired(skin.uid.tolist())]
    return (
        f'[source]\nkind = "replay"\npath = "{place}"\nmodules = {listed}\n'
        f'[scene]\nbundle = "{SCENARIO.bundle}"\n'
        f'[skin]\nlayout = "{SCENARIO.layout}"\nfull_scale_counts = {SCENARIO.full_scale_counts}\n'
        f'[sensor_pose]\nendpoint = "ipc://{place}/poses"\n'
        f'[publish]\nendpoints = ["ipc://{place}/stream"]\n'
        f'[control]\nendpoint = "ipc://{place}/control"\n'
    )


def setting(place: str) -> tuple[Config, Layout, bundle.Bundle]:
    """The same, read, and what it names."""
    skin = layouts.load(SCENARIO.layout)
    settings = config_file.parse(configured(place))
    return settings, skin, bundle.load(SCENARIO.bundle, skin, settings.skin.full_scale_depth_m)


def record(place: Path, scenario: Scenario = SCENARIO) -> list[session.PoseRow]:
    """A scenario as a session; → the sensor's poses."""
    _, skin, loaded = setting(str(place))
    modules = wired(skin.uid.tolist())
    world = make_world(scenario, loaded.model, modules, 0)
    path = robot.plan(scenario, loaded.model, world.truth, 0)
    ihb = VirtualIhb(modules)
    with Recorder(place, moves=True) as recorder:
        for tick in range(int((path.duration_s + 2.0) / TICK_S)):
            t = 1e9 + tick * TICK_S
            pose = path.at(tick * TICK_S - 1.5)
            recorder.pose(t, *map(float, pose))
            if tick % 5:
                continue
            for command, payload in ihb.sensor_data(world.counts(pose, t)):
                for frame in cyskin.to_frames(command, payload, ihb=ihb.short_id, t=t):
                    recorder.take(frame)
    return session.read_poses(place / session.POSES)


def _run(place: str, poses: list[session.PoseRow], client: tuple[str, ...]) -> float:
    """Mean CPU seconds of a tick over the session."""
    clock = FakeTime()
    daemon = Daemon(setting(place)[0])
    clock.give(daemon)
    spent, ticks = 0.0, 0
    try:
        with connected(client, place), clock.installed():
            _settle(daemon.publisher, bool(client) and client[0] in (READS, STALLS))
            for t, *_ in poses:  # which the replay takes by itself
                clock.now_s = t - poses[0][0]
                start = time.thread_time()
                daemon.tick(clock.now_s)
                spent += time.thread_time() - start
                ticks += 1
                time.sleep(REST_S)
    finally:
        daemon.close()
    assert daemon.pipeline.estimate.contacts >= SCENARIO.contacts
    return spent / ticks


if __name__ == "__main__":
    for figure, measured, budget in rows():
        print(f"{figure:52s} {measured:12.3f} {'' if budget is None else budget:>10}")
