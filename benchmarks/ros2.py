"""What the bridge to ROS 2 adds: from the moment at which a ZeroMQ subscriber could have had an
estimate to that at which a DDS reader of another process has the pose; and the bridge's CPU time.

    chrt -f 10 python benchmarks/ros2.py [--seconds 30] [--rate-hz 100]

All on this machine's loopback; subscriber and reader are one process, so both are woken alike. As
for the daemon, a real-time priority keeps the neighbours of a busy machine out of the figures.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgpack
import numpy as np
import zmq

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.ros2.loopback import DOMAIN, ENVIRONMENT, Daemon

from taxeld_ros2 import ros_types as ros
from taxeld_ros2.convert import time_of
from taxeld_ros2.dds import RELIABLE, Participant, last, taken

PARTICLES = 400  # as many as a wide belief has
PARTICLES_HZ = 20.0
BUDGET_MS = 1.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate-hz", type=float, default=100.0)
    args = parser.parse_args()
    os.environ.update(ENVIRONMENT)
    for markers in (False, True):
        figures(args.seconds, args.rate_hz, markers)
    return 0


def figures(seconds: float, rate_hz: float, markers: bool) -> None:
    with tempfile.TemporaryDirectory() as place:
        daemon = Daemon(Path(place))
        with Ears(daemon.endpoint) as ears, bridge(daemon.endpoint, markers) as process:
            wait(daemon, ears)
            ears.forget()
            before = cpu_s(process.pid)
            sent = publish(daemon, seconds, rate_hz)
            spent = cpu_s(process.pid) - before
            time.sleep(1.0)
        daemon.close()
    both = [s for s in sent if s in ears.plain and s in ears.bridged]
    added = 1e3 * np.array([ears.bridged[s] - ears.plain[s] for s in both])
    p50, p99, top = np.percentile(added, (50, 99, 100))
    what = "with particles and markers" if markers else "poses and modes alone"
    print(f"{what}: {len(both)} of {len(sent)} estimates at {rate_hz:g} Hz")
    print(f"  added [ms]: p50 {p50:.2f}, p99 {p99:.2f} (budget {BUDGET_MS:g}), max {top:.2f}")
    print(f"  CPU of the bridge: {100.0 * spent / seconds:.1f} % of a core")


class Ears:
    """When each estimate came, by its time in nanoseconds: over ZeroMQ, and over the bridge."""

    def __init__(self, endpoint: str) -> None:
        self.plain: dict[int, float] = {}
        self.bridged: dict[int, float] = {}
        self._endpoint = endpoint
        self._is_over = False
        self._thread = threading.Thread(target=self._listen)

    def __enter__(self) -> "Ears":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._thread.join()

    def forget(self) -> None:
        self.plain.clear()
        self.bridged.clear()

    def _listen(self) -> None:
        wake = os.eventfd(0, os.EFD_NONBLOCK)
        dds = Participant(DOMAIN)
        reader = dds.reader(
            "taxeld/pose", ros.PoseWithCovarianceStamped, last(1000, RELIABLE),
            lambda: os.eventfd_write(wake, 1),
        )  # fmt: skip
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.SUBSCRIBE, b"/taxeld/estimate")
            socket.connect(self._endpoint)
            poller = zmq.Poller()
            poller.register(socket, zmq.POLLIN)
            poller.register(wake, zmq.POLLIN)
            while not self._is_over:
                ready = dict(poller.poll(50))
                now = time.monotonic()
                if socket in ready:
                    t = msgpack.unpackb(socket.recv_multipart()[1])["t"]
                    stamp = time_of(t)
                    self.plain[stamp.sec * 1_000_000_000 + stamp.nanosec] = now
                if wake in ready:
                    os.eventfd_read(wake)
                    for message in taken(reader):
                        stamp = message.header.stamp
                        self.bridged[stamp.sec * 1_000_000_000 + stamp.nanosec] = now


@contextmanager
def bridge(endpoint: str, markers: bool) -> Iterator["subprocess.Popen[bytes]"]:
    command = [sys.executable, "-m", "taxeld_ros2.cli", "--stream", endpoint]
    process = subprocess.Popen([*command, *([] if markers else ["--no-markers"])], env=ENVIRONMENT)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def wait(daemon: Daemon, ears: Ears) -> None:
    deadline = time.monotonic() + 60.0
    while len(ears.bridged) < 10:
        assert time.monotonic() < deadline, "nothing came over the bridge"
        daemon.say()
        time.sleep(0.05)


def publish(daemon: Daemon, seconds: float, rate_hz: float) -> list[int]:
    """→ the times of the estimates that were sent."""
    sent, begun, next_cloud = [], time.monotonic(), 0.0
    cloud = {"xytheta": [[0.1, 0.2, 0.3]] * PARTICLES, "weight": [1.0 / PARTICLES] * PARTICLES}
    for k in range(round(seconds * rate_hz)):
        time.sleep(max(0.0, begun + k / rate_hz - time.monotonic()))
        stamp = time_of(daemon.say()["t"])
        sent.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        if k / rate_hz >= next_cloud:
            next_cloud += 1.0 / PARTICLES_HZ
            daemon.send(b"/taxeld/particles", **cloud)
    return sent


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main())
