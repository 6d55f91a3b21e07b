"""`make bench`: what the wire, a tick, a touch and a running daemon cost, beside their budgets.

CPU time and counts, medians over interleaved rounds; wall-clock figures are printed, not judged.
What is CPU time is told in loops of this machine's as well (`yardstick`): that column can be
compared between machines.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from taxeld.command_line import one_thread

one_thread()  # as the daemon has

import numpy as np

import adapter
import decoding
import escapes
import fuzzing
import installed
import protocol
import service
import streams
import yardstick
from taxeld import native
from taxeld.config import file as config_file
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.model.activation import Activation
from taxeld.proposals import bundle
from taxeld.service.loop import Daemon

ROUNDS = 7
TOUCHES = 20
IDLE_TICKS = 2000
Row = tuple[str, float, float | None]  # a figure, measured, and its budget


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures there as well")
    parser.add_argument("--no-demo", action="store_true", help="leave the real-time demo out")
    args = parser.parse_args()
    loop = yardstick.Loop()
    lines: list[dict[str, str | float | None]] = []
    for group in (
        installed.rows, protocol.rows, escapes.rows, adapter.rows, decoding.rows, fuzzing.rows,
        touches, idle_tick, streams.rows, service.rows, *(() if args.no_demo else (demo,)),
    ):  # fmt: skip
        with loop.around():
            found = [*group()]
        lines += [
            {"figure": figure, "measured": measured, "loops": loop.ratio(figure, measured),
             "budget": budget}
            for figure, measured, budget in found
        ]  # fmt: skip
    print(f"{'figure':60s} {'measured':>12s} {'loops':>10s} {'budget':>10s}")
    for line in lines:
        numbers = (line["measured"], line["loops"], line["budget"])
        told = ("" if number is None else f"{number:.3f}" for number in numbers)
        print("{:60s} {:>12s} {:>10s} {:>10s}".format(line["figure"], *told))
    print(f"{'a loop of the yardstick: CPU ms':60s} {loop.ms:12.3f}")
    if args.json:
        args.json.write_text(json.dumps(lines, indent=1) + "\n", encoding="utf-8")
    return 0


def cpu_ms(work: Callable[[], None], times: int) -> float:
    """Median CPU milliseconds of one `work` over rounds of `times`."""
    spent = []
    for _ in range(ROUNDS):
        start = time.process_time()
        for _ in range(times):
            work()
        spent.append((time.process_time() - start) / times * 1e3)
    return float(np.median(spent))


def touches() -> list[Row]:
    """One touch through the estimator with S = 100, N = 100: the baseline, each sampler, and the
    shipped one without the code in C."""
    skin = layouts.load(SkinConfig().layout)
    loaded = bundle.load("box", skin, 0.005)
    model = loaded.model
    rng = np.random.default_rng(0)
    settings = FilterConfig(particles=100, particles_max=100, injected=100)
    poses = contacts.synthesise(model.scene, skin.radius_m, 0.005, 2000, rng).pose
    pressed = poses[model.activation(poses).max(axis=1) > 0.3][:TOUCHES]
    readings = model.activation(pressed)
    sensors = se2.inverse(pressed)  # the object stands at the origin
    live = np.ones(len(skin), dtype=bool)
    rows: list[Row] = []
    shipped = loaded.info["auto"][0]
    by_c = ["projection", *(s["name"] for s in loaded.info["samplers"])]
    for name, switch in [*((name, "1") for name in by_c), (shipped, "0")]:
        os.environ[native.SWITCH] = switch
        native.library.cache_clear()
        sampler = "" if name == "projection" else name
        kind = "projection" if name == "projection" else "auto"
        estimator = Estimator(model, loaded.proposal(kind, sampler), settings)
        spent: list[float] = []
        t = 0.0
        for _ in range(ROUNDS):
            # press, hold, let go: the second scan is judged
            for z, sensor in zip(readings, sensors, strict=True):
                estimator.on_scan(Activation(t, z, live), sensor)
                start = time.process_time()
                estimate = estimator.on_scan(Activation(t + 0.05, z, live), sensor)
                spent.append((time.process_time() - start) * 1e3)
                assert estimate.injected >= 50
                for gap in (0.1, 0.3):
                    estimator.on_scan(Activation(t + gap, 0.0 * z, live), sensor)
                t += 1.0
        how = name if switch == "1" else f"{name}, numpy alone"
        figure = f"a touch, N = 100, S = 100, {how}: CPU ms"
        budget = 5.0 if (name, switch) == (shipped, "1") else None
        rows.append((figure, float(np.median(spent)), budget))
    del os.environ[native.SWITCH]
    native.library.cache_clear()
    return rows


def idle_tick() -> list[Row]:
    """A tick of a whole daemon to which nothing comes."""
    with tempfile.TemporaryDirectory() as place:
        endpoint = f"ipc://{place}/"
        settings = config_file.parse(
            f'[source]\nkind = "can"\ninterface = "virtual"\nchannel = "bench"\n'
            f'[scene]\nbundle = "box"\n[publish]\nendpoints = ["{endpoint}stream"]\n'
            f'[control]\nendpoint = "{endpoint}control"\n'
            f'[sensor_pose]\nendpoint = "{endpoint}poses"\n'
        )
        daemon = Daemon(replace(settings))
        ticks = iter(np.arange(10**7) * 0.01)
        spent = cpu_ms(lambda: daemon.tick(float(next(ticks))), IDLE_TICKS)
        daemon.close()
    return [("a tick without a scan: CPU ms", spent, 0.3)]


def demo() -> list[Row]:
    """The demo in real time, and the daemon's memory at the end of it, as it says itself."""
    with tempfile.TemporaryDirectory() as place:
        start = time.monotonic()
        command = [sys.executable, "-m", "taxeld_hil.cli", "run", "demo", "--out", place]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        took = time.monotonic() - start
        peak_mb = replayed_peak_mb(Path(place))
    return [
        ("the demo: wall seconds", took, 60.0),
        ("the daemon's peak resident memory, MB", peak_mb, 150.0),
    ]


def replayed_peak_mb(directory: Path) -> float:
    """Peak memory of `taxeld run` on the session, through its whole loop."""
    text = (directory / "config.toml").read_text(encoding="utf-8")
    head, rest = text.split("[source]")
    _, scene = rest.split("[scene]")
    scene = scene.split("[sensor_pose]")[0]
    settings = directory / "replayed.toml"
    settings.write_text(
        f'{head}[source]\nkind = "replay"\npath = "{directory}"\n[scene]{scene}'
        f'[publish]\nendpoints = ["ipc://{directory}/stream"]\n[control]\nendpoint = ""\n',
        encoding="utf-8",
    )
    daemon = subprocess.Popen([sys.executable, "-m", "taxeld.cli", "run", str(settings)])
    peak = 0.0
    while daemon.poll() is None:
        status = Path(f"/proc/{daemon.pid}/status")
        try:
            lines = status.read_text(encoding="ascii").splitlines()
        except OSError:
            break
        peak = max([peak, *(float(x.split()[1]) / 1024 for x in lines if x.startswith("VmHWM"))])
        time.sleep(0.2)
    return peak


if __name__ == "__main__":
    sys.exit(main())
