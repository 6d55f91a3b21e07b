"""`python benchmarks/arrays.py`: a core's share of a daemon on arrays, and on CySkin's frames.

Nothing touches the skin, and there is no robot.
"""

import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import zmq

import service
from taxeld.layout import read as layouts
from taxeld.stream import client
from taxeld_protocol.modules import wired

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from tests.rig.configurations import configuration
from tests.rig.virtual_hub import VirtualHub

SMALL = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
LARGE = "cylinder:rows=5,columns=200,radius_m=0.04,pitch_m=0.015"
SETTLE_S, SECONDS = 8.0, 20.0
CASES = (  # how they come, the layout, scans a second
    ("frames", SMALL, 20.0),
    ("frames", SMALL, 50.0),
    ("zmq z", SMALL, 50.0),
    ("zmq z", SMALL, 20.0),
    ("zmq counts", SMALL, 20.0),
    ("udp z", SMALL, 20.0),
    ("zmq z", SMALL, 100.0),
    ("udp z", LARGE, 100.0),
    ("zmq z", LARGE, 100.0),
    ("zmq counts", LARGE, 100.0),
)


def main() -> None:
    print(
        f"{'':12s} {'taxels':>6s} {'Hz':>5s} {'loop, % of a core':>18s} {'door':>6s} {'used':>6s}"
    )
    for how, spec, rate_hz in CASES:
        with tempfile.TemporaryDirectory() as place:
            taxels, loop, door, used = measured(Path(place), how, spec, rate_hz)
        print(f"{how:12s} {taxels:6d} {rate_hz:5.0f} {loop:18.2f} {door:6.2f} {used:6d}")


def measured(place: Path, how: str, spec: str, rate_hz: float) -> tuple[int, float, float, int]:
    """Taxels; percent of a core of the loop and of its door; scans in this time."""
    skin = layouts.load(spec)
    endpoint = "udp://127.0.0.1:9871" if how.startswith("udp") else f"ipc://{place}/skin"
    source: dict[str, object] = {
        "kind": "array",
        "endpoint": endpoint,
        "period_ms": round(1000 / rate_hz),
    }
    if how == "frames":
        source = {"kind": "can", "interface": "slcan", "channel": str(place / "hub")}
    source["period_ms"] = round(1000 / rate_hz)
    scene = {"bundle": "box" if spec == SMALL else str(service.large_bundle(place / "box", LARGE))}
    config = configuration(place, skin={"layout": spec}, source=source, scene=scene)
    stops = threading.Event()
    send = hub if how == "frames" else arrays
    sender = threading.Thread(target=send, args=(place, how, endpoint, spec, rate_hz, stops))
    sender.start()
    command = [sys.executable, "-m", "taxeld.cli", "run", str(config)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as daemon:
        time.sleep(SETTLE_S)
        before, begun = [scans(place), *cpu_s(daemon.pid)], time.monotonic()
        time.sleep(SECONDS)
        after, took = [scans(place), *cpu_s(daemon.pid)], time.monotonic() - begun
        daemon.terminate()
    stops.set()
    sender.join()
    loop, door = (100.0 * (b - a) / took for a, b in zip(before[1:], after[1:], strict=True))
    return len(skin), loop, door, int(after[0] - before[0])


def scans(place: Path) -> int:
    told = client.ask(f"ipc://{place}/control", "status", timeout_s=5.0)
    return int(told["health"]["source"]["scans"]) if told else 0


def cpu_s(pid: int) -> list[float]:
    """CPU time of a process, and of its children."""
    children = [
        p for path in Path(f"/proc/{pid}/task").glob("*/children") for p in path.read_text().split()
    ]
    return [_cpu_s(str(pid)), sum(map(_cpu_s, children))]


def _cpu_s(pid: str) -> float:
    words = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def ticks(rate_hz: float, stops: threading.Event) -> Iterator[float]:
    """Unix times at this rate."""
    due_s = time.monotonic()
    while not stops.wait(max(0.0, due_s - time.monotonic())):
        due_s += 1.0 / rate_hz
        yield time.time()


def arrays(
    _: Path, how: str, endpoint: str, spec: str, rate_hz: float, stops: threading.Event
) -> None:
    rng, size, key = np.random.default_rng(0), len(layouts.load(spec)), how.split()[1]
    with (
        zmq.Context() as context,
        context.socket(zmq.PUB) as skin,
        socket.socket(type=socket.SOCK_DGRAM) as datagrams,
    ):
        skin.setsockopt(zmq.LINGER, 0)
        if not how.startswith("udp"):
            skin.bind(endpoint)
        for t in ticks(rate_hz, stops):
            noise = rng.standard_normal(size)
            values = 0.002 * np.abs(noise) if key == "z" else np.round(10_000 + 34 * noise)
            body = msgpack.packb({"t": t, "id": "skin", key: values.tolist()})
            if how.startswith("udp"):
                datagrams.sendto(body, ("127.0.0.1", 9871))
            else:
                skin.send(body)


def hub(
    place: Path, _how: str, _end: str, spec: str, rate_hz: float, stops: threading.Event
) -> None:
    rng = np.random.default_rng(0)

    def draw(channels: int) -> list[int]:
        return (10_000 + 34 * rng.standard_normal(channels)).astype(int).tolist()

    with VirtualHub(place / "hub", wired(layouts.load(spec).uid.tolist())) as made:
        for _ in ticks(rate_hz * 10, stops):
            made.serve(time.monotonic(), lambda _: draw(88))


if __name__ == "__main__":
    main()
