"""Those who watch while a daemon is attacked: a subscriber, a client, and the kernel's accounts."""

import os
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld.stream import messages

NEAR_M = 0.1
AGAIN_S = 0.5  # a client that has no answer for so long connects and asks anew, as `taxeld` does
WAIT_MAX = 4  # estimates, of which 20 a second come
TAXELS_MAX = 10
PAUSED_MAX_S = 0.3
REST_S = 0.1  # between its questions
PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 2**20
TOPICS = messages.ESTIMATE, messages.TAXELS, messages.PARTICLES, messages.HEALTH
HEADER = (
    f"{'attack':31s} {'daemon':18s} {'relay':18s} {'missed':>6s} {'tcp':>6s} {'invalid':>7s}"
    f" {'silent':>6s} {'off m':>8s} {'end m':>8s} {'own':>4s} {'ms/est.':>7s} {'MB':>6s}"
    f" {'relay MB':>8s} {'answer':>6s} newcomer; what was done"
)


@dataclass(frozen=True)
class Row:
    """One attack. Ticks are the loop's, a hundredth of a second."""

    attack: str
    daemon: str  # alive, or how it ended and when
    relay: str
    missed: int | None  # estimates, by the healthy subscriber on ipc; None: all since its end
    missed_tcp: int  # by one over TCP
    invalid: int  # estimates that said of themselves that they are of no use
    silent_taxels: int  # estimates since the last taxels, at the end
    off_m: float  # the farthest from the object of all valid estimates
    error_m: float | None  # at the end; None: not valid then
    own_overruns: int
    loop_ms: float  # CPU time of the loop's thread, an estimate
    grown_mb: float  # resident memory, at most
    relay_grown_mb: float
    answer_estimates: (
        int | None
    )  # the longest that a client waited for `status`; None: it still does
    newcomer: bool  # somebody who subscribed afterwards was served
    paused_s: float  # the longest that those who watch were held up themselves
    did: dict[str, int] | None  # connections, messages and bytes; None: no process of its own

    @property
    def is_disturbed(self) -> bool:
        """Whether it tells of a busy machine rather than of the daemon."""
        return self.paused_s > PAUSED_MAX_S

    def line(self) -> str:
        missed = "all" if self.missed is None else str(self.missed)
        answer = "none" if self.answer_estimates is None else str(self.answer_estimates)
        error = "-" if self.error_m is None else f"{self.error_m:.2g}"
        did = "".join(f" {count} {what}," for what, count in (self.did or {}).items())
        return (
            f"{self.attack:31s} {self.daemon:18s} {self.relay:18s} {missed:>6s}"
            f" {self.missed_tcp:6d} {self.invalid:7d} {self.silent_taxels:6d} {self.off_m:8.2g}"
            f" {error:>8s} {self.own_overruns:4d} {self.loop_ms:7.2f} {self.grown_mb:6.1f}"
            f" {self.relay_grown_mb:8.1f} {answer:>6s} {'served' if self.newcomer else 'deaf'};"
            f"{did}".rstrip(",;")
        )


class Process:
    """The daemon or the relay; what it says on standard error is kept."""

    def __init__(self, command: list[str], environ: dict[str, str], place: Path) -> None:
        self._said = place / f"{command[-2]}.stderr"
        self._done: set[object] = set()
        with self._said.open("wb") as said:
            self._process = subprocess.Popen(command, env=environ, stderr=said)
        self.pid = self._process.pid
        self._settled_mb = 0.0

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    @property
    def status(self) -> int | None:
        return self._process.returncode

    def end(self) -> str:
        return self._said.read_text(encoding="utf-8", errors="replace").strip()

    def is_first(self, what: object) -> bool:
        """Whether this is asked for the first time."""
        before = len(self._done)
        self._done.add(what)
        return len(self._done) > before

    def signal_once(self, *numbers: int) -> None:
        for number in numbers:
            if self.is_alive and self.is_first(number):
                self._process.send_signal(number)

    def resident_mb(self) -> float:
        try:
            pages = Path(f"/proc/{self.pid}/statm").read_text(encoding="ascii").split()[1]
        except (OSError, IndexError):
            return 0.0
        return int(pages) * PAGE_MB

    def has_settled(self) -> None:
        """From here on it should not grow."""
        self._settled_mb = self.resident_mb()

    def has_grown(self, mb: float) -> bool:
        return self.resident_mb() - self._settled_mb > mb

    def loop_cpu_s(self) -> float:
        """CPU time of its first thread, which is the loop's."""
        try:
            path = Path(f"/proc/{self.pid}/task/{self.pid}/schedstat")
            return int(path.read_text(encoding="ascii").split()[0]) / 1e9
        except (OSError, IndexError):
            return 0.0

    def stop(self) -> None:
        if self.is_alive:
            self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Listener:
    """A subscriber that keeps up, and counts what it misses."""

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        truth: np.ndarray | None = None,
        topics: Sequence[bytes] = TOPICS,
    ) -> None:
        self.estimates = self.missed = self.invalid = self.seq = self.taxels_seq = 0
        self.is_valid = False
        self.error_m = self.off_m = 0.0
        self.health: dict[str, Any] = {}
        self.health_s = 0.0  # monotonic
        self._truth = truth
        self._socket = context.socket(zmq.SUB)
        self._socket.linger = 0
        self._socket.rcvhwm = 0  # what is lost is lost on the other side
        for topic in topics:  # one by one: who asks for all cannot be told from by a stranger
            self._socket.subscribe(topic)
        self._socket.connect(endpoint)

    @property
    def is_well(self) -> bool:
        """Whether what it hears is of use, and all there."""
        is_felt = self.seq - self.taxels_seq < TAXELS_MAX
        return self.is_valid and is_felt and self.error_m < NEAR_M

    def hear(self) -> None:
        while int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            topic, body, _ = self._socket.recv_multipart()
            if topic == messages.ESTIMATE:
                self._judge(msgpack.unpackb(body))
            elif topic == messages.TAXELS:
                self.taxels_seq = msgpack.unpackb(body)["seq"]
            elif topic == messages.HEALTH:
                self.health, self.health_s = msgpack.unpackb(body), time.monotonic()

    def close(self) -> None:
        self._socket.close()

    def _judge(self, estimate: dict[str, Any]) -> None:
        if self.estimates:
            self.missed += estimate["seq"] - self.seq - 1
        self.estimates += 1
        self.seq, self.is_valid = estimate["seq"], estimate["valid"]
        self.invalid += not self.is_valid
        if self._truth is not None:
            where = np.array([estimate["map"]["x"], estimate["map"]["y"]])
            self.error_m = float(np.linalg.norm(where - self._truth))
            self.off_m = max(self.off_m, self.error_m * self.is_valid)


class Client:
    """Asks for `status` all the time, each time over a connection of its own, as `taxeld` does; how
    long it waits is counted in estimates."""

    def __init__(self, context: zmq.Context[Any], endpoint: str) -> None:
        self.longest = self._waited = 0  # estimates
        self.answered_s = 0.0  # monotonic
        self._context, self._endpoint = context, endpoint
        self._asked_seq: int | None = None
        self._is_again = False
        self._next_s = self._again_s = 0.0
        self._socket = self._connected()

    @property
    def is_well(self) -> bool:
        """Whether the last answer came soon, and a moment ago."""
        return time.monotonic() - self.answered_s < AGAIN_S and self._waited <= WAIT_MAX

    def step(self, seq: int) -> None:
        """`seq`: of the estimate that was heard last."""
        now = time.monotonic()
        if self._asked_seq is None:
            if now >= self._next_s and seq:
                self._asked_seq, self._is_again = seq, False
                self._ask(now)
        elif int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            self._socket.recv()
            self._waited = seq - self._asked_seq
            self.longest = max(self.longest, self._waited)
            self._asked_seq = None
            self.answered_s, self._next_s = now, now + REST_S
        elif now >= self._again_s:
            self._is_again = True
            self._ask(now)

    @property
    def waits(self) -> bool:
        """Whether an answer is late enough for it to have asked again."""
        return self._asked_seq is not None and self._is_again

    def close(self) -> None:
        self._socket.close()

    def _ask(self, now: float) -> None:
        self._again_s = now + AGAIN_S
        self._socket.close()
        self._socket = self._connected()
        self._socket.send(msgpack.packb({"cmd": "status"}))

    def _connected(self) -> zmq.Socket[Any]:
        made: zmq.Socket[Any] = self._context.socket(zmq.REQ)
        made.linger = 0
        made.connect(self._endpoint)
        return made


@dataclass
class Account:
    """What was when an attack began, and the most of what it took."""

    daemon: Process
    relay: Process | None
    stream: Listener
    over_tcp: Listener
    client: Client
    _peak_mb: float = 0.0
    _relay_peak_mb: float = 0.0
    _paused_s: float = 0.0
    _ended_s: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._resident_mb = self.daemon.resident_mb()
        self._relay_mb = self.relay.resident_mb() if self.relay else 0.0
        self._cpu_s, self._seq = self.daemon.loop_cpu_s(), self.stream.seq
        self._last_cpu_s = self._cpu_s
        self._watched_s = time.monotonic()
        self._own = self.stream.health["loop"]["own_overruns"]
        for listener in (self.stream, self.over_tcp):
            listener.missed = listener.invalid = 0
            listener.off_m = 0.0
        self.client.longest = 0

    @property
    def is_alive(self) -> bool:
        return self.daemon.is_alive

    def watch(self) -> float:
        """→ the most MB that one of them has grown by."""
        now = time.monotonic()
        self._paused_s = max(self._paused_s, now - self._watched_s)
        self._watched_s = now
        for process in (self.daemon, self.relay):
            if process is not None and not process.is_alive:
                self._ended_s.setdefault(process.pid, now)
        self._peak_mb = max(self._peak_mb, self.daemon.resident_mb() - self._resident_mb)
        if self.relay is not None:
            self._relay_peak_mb = max(
                self._relay_peak_mb, self.relay.resident_mb() - self._relay_mb
            )
        self._last_cpu_s = self.daemon.loop_cpu_s() or self._last_cpu_s
        return max(self._peak_mb, self._relay_peak_mb)

    def row(self, attack: str, began_s: float, newcomer: bool, did: dict[str, int] | None) -> Row:
        stream, alive = self.stream, self.daemon.is_alive
        estimates = max(1, stream.seq - self._seq)
        waits = self.client.waits
        return Row(
            attack=attack,
            daemon=self._fate(self.daemon, began_s),
            relay=self._fate(self.relay, began_s),
            missed=stream.missed if alive else None,
            missed_tcp=self.over_tcp.missed,
            invalid=stream.invalid,
            silent_taxels=stream.seq - stream.taxels_seq,
            off_m=stream.off_m,
            error_m=stream.error_m if alive and stream.is_valid else None,
            own_overruns=stream.health["loop"]["own_overruns"] - self._own,
            loop_ms=1e3 * (self._last_cpu_s - self._cpu_s) / estimates,
            grown_mb=self._peak_mb,
            relay_grown_mb=self._relay_peak_mb,
            answer_estimates=self.client.longest if alive and not waits else None,
            newcomer=newcomer,
            paused_s=self._paused_s,
            did=did,
        )

    def _fate(self, process: Process | None, began_s: float) -> str:
        if process is None:
            return "-"
        if process.is_alive:
            return "alive"
        after_s = self._ended_s.get(process.pid, time.monotonic()) - began_s
        status = process.status or 0
        how = signal.Signals(-status).name if status < 0 else f"status {status}"
        return f"{how} after {after_s:.1f} s"
