"""A daemon that is attacked: its skin, its robot, its relay, and the attackers' processes."""

import json
import os
import resource
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgpack
import numpy as np
import zmq

import hostile_watch as watch
import service
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld.stream import messages
from taxeld_hil.rig.ports import SlcanPort
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

HERE = Path(__file__).resolve().parent
SHORT_S = 0.6  # an attack in short form
START_S = 60.0
UNTOUCHED_S, TOUCHED_S = 2.0, 1.5  # the baseline, and the first touches
SETTLE_S = 6.0  # until health, an answer and an estimate for a newcomer have come
SHORT_LATE_S = 1.2
ACT_S = 0.01  # between acts of those who are no process of their own
GROWN_MB = 20.0
GROWN_MAX_MB = 1200.0  # an attack ends there: the machine is others' as well
FAR_M = 1e9
Door = Literal["stream", "control", "tcp stream", "tcp control", "asking"]


@dataclass(frozen=True)
class Attack:
    """`act` is called now and then; `program` is one of attacks.py, `count` what bounds it."""

    name: str
    program: str = ""
    door: Door = "stream"
    count: int = 0
    short: int = 0  # the count in short form
    seconds: float = 5.0
    late_s: float = 0.0  # what it does may show so late
    limits_files: bool = False  # the target may open fewer files than there are connections
    act: Callable[["World"], None] | None = None
    in_short: bool = True


class World:
    """A skin, its robot, a daemon, a relay, and those who watch."""

    def __init__(self, stack: ExitStack, command: list[str], path: str) -> None:
        self.place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self._command, self._environ = command, {**os.environ, "PYTHONPATH": path}
        asked = subprocess.run(
            [*command, "relay", "--help"], env=self._environ, capture_output=True, check=False
        )
        self._has_relay = asked.returncode == 0
        self._context = stack.enter_context(zmq.Context())
        skin = layouts.load(service.SKIN)
        self._bundle = bundle.load("box", skin, 0.005)
        self._uids = skin.uid.tolist()
        self.poses = stack.enter_context(self._context.socket(zmq.PUB))
        self.poses.linger = 0
        self.poses.bind(f"ipc://{self.place}/poses")
        self.voice = Voice(self.poses)
        self._ready = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        self._ready.bind(str(self.place / "notify"))
        self.daemon: watch.Process | None = None
        self.relay: watch.Process | None = None
        self._alive: ExitStack = stack.enter_context(ExitStack())
        self._next_act_s = 0.0

    def suffer(self, attack: Attack, short: bool) -> watch.Row | None:
        """One attack, and what came of it; None where there is no such door."""
        if not self._is_well(short):
            self._start()
        endpoint = self._endpoint(attack.door)
        if endpoint is None or self.daemon is None:
            return None
        seconds = min(attack.seconds, SHORT_S) if short else attack.seconds
        count = attack.short if short else attack.count
        target = self.daemon
        if attack.door.startswith("tcp") and self.relay is not None:
            target = self.relay
        before = watch.Account(self.daemon, self.relay, self.stream, self.over_tcp, self.client)
        limits = resource.prlimit(target.pid, resource.RLIMIT_NOFILE)
        if attack.limits_files:
            open_files = len(list(Path(f"/proc/{target.pid}/fd").iterdir()))
            fewer = min(limits[0], open_files + count // 2)
            resource.prlimit(target.pid, resource.RLIMIT_NOFILE, (fewer, limits[1]))
        began_s = time.monotonic()
        did = self._attack(attack, endpoint, seconds, count, before)
        if attack.limits_files and target.is_alive:
            resource.prlimit(target.pid, resource.RLIMIT_NOFILE, limits)
        late_s = min(attack.late_s, SHORT_LATE_S) if short else attack.late_s
        reached = self._settle(before, late_s)
        return before.row(attack.name, began_s, reached, did)

    def _attack(
        self, attack: Attack, endpoint: str, seconds: float, count: int, account: watch.Account
    ) -> dict[str, int] | None:
        """→ what an attacker says that it has done; nothing of one that had to be ended."""
        until_s = time.monotonic() + seconds
        attacker = None
        if attack.program:
            program = [sys.executable, str(HERE / "attacks.py"), attack.program]
            attacker = subprocess.Popen(
                [*program, endpoint, str(seconds), str(count)], stdout=subprocess.PIPE
            )
            until_s += START_S  # it counts its seconds itself, from its start on
        while time.monotonic() < until_s and account.watch() < GROWN_MAX_MB:
            self._step()
            if attacker is not None and attacker.poll() is not None:
                break
            if attack.act is not None and time.monotonic() >= self._next_act_s:
                self._next_act_s = time.monotonic() + ACT_S
                attack.act(self)
        if attacker is None:
            return None
        attacker.kill()
        said = attacker.communicate()[0]
        return json.loads(said) if said else {}

    def _settle(self, account: watch.Account, late_s: float) -> bool:
        """Wait for health, an answer and whatever else is late; → whether a newcomer heard."""
        began_s = time.monotonic()
        place = f"ipc://{self.place}/stream"
        newcomer = watch.Listener(self._context, place, topics=(messages.ESTIMATE,))
        with closing(newcomer):
            while time.monotonic() < began_s + SETTLE_S and account.is_alive:
                account.watch()
                self._step()
                newcomer.hear()
                is_heard = self.stream.health_s > began_s and self.client.answered_s > began_s
                is_over = time.monotonic() > began_s + late_s
                if is_heard and is_over and newcomer.estimates:
                    break
            return newcomer.estimates > 0

    def serve(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self._step()

    def _step(self) -> None:
        self._robot._step()
        self.stream.hear()
        self.over_tcp.hear()
        self.client.step(self.stream.seq)

    def _is_well(self, short: bool) -> bool:
        """Whether the daemon lives and answers, so that it can be attacked again."""
        if self.daemon is None or not self.daemon.is_alive:
            return False
        if self.relay is not None and not self.relay.is_alive:
            return False
        grown = self.daemon.has_grown(GROWN_MB) or (self.relay and self.relay.has_grown(GROWN_MB))
        if grown and not short:  # what is free in it would hide the next growth
            return False
        return self._is_served()

    def _is_served(self) -> bool:
        """Whether those who watch get what they should, within a moment."""
        for _ in range(10):
            self.serve(0.2)
            if self.stream.is_well and self.client.is_well:
                return True
        return False

    def _start(self) -> None:
        """Another daemon, and another relay."""
        self._alive.close()
        hub = VirtualIhb(wired(self._uids))
        port = self._alive.enter_context(closing(SlcanPort(self.place / "skin", lambda _: None)))
        self._robot = Robot(self._bundle, True, hub, port, self.voice)
        self._tcp = f"tcp://127.0.0.1:{_free_port()}", f"tcp://127.0.0.1:{_free_port()}"
        settings = self.place / "config.toml"
        settings.write_text(self._settings(), encoding="utf-8")
        environ = {**self._environ, "NOTIFY_SOCKET": str(self.place / "notify")}
        self.daemon = watch.Process([*self._command, "run", str(settings)], environ, self.place)
        self._alive.callback(self.daemon.stop)
        self.relay = None
        if self._has_relay:
            command = [*self._command, "relay", str(settings)]
            self.relay = watch.Process(command, self._environ, self.place)
            self._alive.callback(self.relay.stop)
        truth = self._robot.truth
        stream = f"ipc://{self.place}/stream"
        self.stream = watch.Listener(self._context, stream, truth)
        self._alive.callback(self.stream.close)
        self.over_tcp = watch.Listener(self._context, self._tcp[0], truth)
        self._alive.callback(self.over_tcp.close)
        self.client = watch.Client(self._context, f"ipc://{self.place}/control")
        self._alive.callback(self.client.close)
        deadline_s = time.monotonic() + START_S
        while not self.stream.estimates or not self.over_tcp.estimates:
            assert time.monotonic() < deadline_s, "the daemon was never heard"
            assert self.daemon.is_alive, self.daemon.end()
            self._step()
        self._robot.come()
        self.serve(UNTOUCHED_S + TOUCHED_S)
        while not self._is_served():
            assert time.monotonic() < deadline_s, "the daemon found nothing"
        for process in (self.daemon, self.relay):
            if process is not None:
                process.has_settled()

    def _settings(self) -> str:
        place, (stream, control) = self.place, self._tcp
        text = (
            f'[skin]\nlayout = "{service.SKIN}"\nfull_scale_counts = {service.FULL_SCALE}\n'
            f'[source]\nkind = "serial"\nframing = "slcan"\nchannel = "{place}/skin"\n'
            f'[scene]\nbundle = "box"\n[sensor_pose]\nendpoint = "ipc://{place}/poses"\n'
            f'[filter]\nparticles_max = 100\n[control]\nendpoint = "ipc://{place}/control"\n'
        )
        ipc = f"ipc://{place}/stream"
        if not self._has_relay:
            return f'{text}[publish]\nendpoints = ["{ipc}", "{stream}"]\n'
        relay = f'[relay]\npublish = ["{stream}"]\ncontrol = "{control}"\n'
        return f'{text}[publish]\nendpoints = ["{ipc}"]\n{relay}'

    def _endpoint(self, door: Door) -> str | None:
        found = {
            "stream": f"ipc://{self.place}/stream",
            "control": f"ipc://{self.place}/control",
            "tcp stream": self._tcp[0],
            "tcp control": self._tcp[1] if self._has_relay else None,
        }
        if door == "asking":  # who may ask only: before, whoever may ask may change as well
            return found["tcp control"] or found["control"]
        return found[door]


class Voice:
    """What the robot itself says of its pose, which may be far from the truth."""

    def __init__(self, poses: zmq.Socket[bytes]) -> None:
        self.far_until_s = 0.0  # monotonic
        self._poses = poses

    def send_multipart(self, frames: tuple[bytes, ...], flags: int) -> None:
        topic, body, stamp = frames
        if time.monotonic() < self.far_until_s:
            pose = msgpack.unpackb(body)
            body = msgpack.packb({**pose, "x": pose["x"] + FAR_M})
        self._poses.send_multipart((topic, body, stamp), flags)


class Robot(service.Robot):
    """One that keeps away until the baseline is known, then rolls the box along the skin."""

    _touches_s = float("inf")

    @property
    def truth(self) -> np.ndarray:
        return np.array(self._seen[:2])

    def come(self) -> None:
        self._touches_s = time.monotonic() + UNTOUCHED_S

    def _at(self, t: float) -> tuple[float, float]:
        yaw, deeper_m = super()._at(t)
        return yaw, deeper_m if time.monotonic() > self._touches_s else -0.03


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
