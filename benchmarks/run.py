"""`make bench`: cost of the wire, of an update and of a running daemon, beside their budgets.

CPU time and counts, medians over rounds; wall-clock figures are printed, not judged. The last row
says how fast this machine is (yardstick.py).
"""

import os
import time

from taxeld.command_line import ONE_THREAD

os.environ |= dict.fromkeys(ONE_THREAD, "1")  # as the daemon has

import numpy as np

import service
import yardstick
from service import Row
from taxeld import native
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.model.observation import Activation
from taxeld.proposals import bundle
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol import cyskin
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import wired

ROUNDS, TOUCHES, SCANS = 7, 20, 60
SATURATED_FRAMES_S = 9_000  # most frames of 8 bytes on a bus of 1 Mbit/s


def main() -> None:
    service.show([*decoding(), *updates()])
    service.show(service.rows(service.SECONDS))
    service.show([("a loop of the yardstick: CPU ms", yardstick.loop_ms(), None)])


def decoding() -> list[Row]:
    """Frames of a hub of 60 modules to scans."""
    modules = wired([(i // 10 + 1) << 4 | (i % 10 + 1) for i in range(600)])
    hub, rng = VirtualIhb(modules), np.random.default_rng(0)
    counts = rng.integers(1, 42_000, (SCANS, sum(module.channels for module in modules))).tolist()
    frames = [
        frame
        for k, scan in enumerate(counts)
        for command, payload in hub.sensor_data(scan)
        for frame in cyskin.to_frames(command, payload, ihb=1, t=k * 0.05)
    ]
    spent = []
    for _ in range(ROUNDS):
        decoder, start = Decoder(lambda _: modules), time.process_time()
        assert sum(len(scans) for _, scans in decoder.take(frames)) == SCANS
        spent.append(time.process_time() - start)
    rate = len(frames) / float(np.median(spent))
    return [("fragments to scans, frames/s (at least)", rate, 10.0 * SATURATED_FRAMES_S)]


def updates() -> list[Row]:
    """One update on contact with S = 100, N = 100, by the bundle's first choice, with the code in C
    and without."""
    skin = layouts.load(SkinConfig().layout)
    loaded = bundle.load("box", skin, 0.005)
    model = loaded.model
    settings = FilterConfig(particles=100, particles_max=100, injected=100)
    made = contacts.synthesise(model.scene, skin.radius_m, 0.005, 2000, np.random.default_rng(0))
    pressed = made.pose[model.activation(made.pose).max(axis=1) > 0.3][:TOUCHES]
    readings = model.activation(pressed)
    sensors = se2.inverse(pressed)  # the object stands at the origin
    live = np.ones(len(skin), dtype=bool)
    rows: list[Row] = []
    for switch, how, budget in (("1", "by C", 5.0), ("0", "by numpy alone", None)):
        os.environ[native.SWITCH] = switch
        native.library.cache_clear()
        estimator = Estimator(model, loaded.proposal(loaded.order[0]), settings)
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
        rows.append((f"an update on contact, {how}: CPU ms", float(np.median(spent)), budget))
    del os.environ[native.SWITCH]
    native.library.cache_clear()
    return rows


if __name__ == "__main__":
    main()
