"""A skin that sends arrays, pressed against the shipped box from all sides, and its robot."""

import threading
import time
from typing import Any

import msgpack
import numpy as np
import zmq

from taxeld.arrays import Floats, Poses
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.proposals import bundle
from tests.rig.pressed_box import TRUTH, box_side

LAYOUT = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
ANGLES = (0.2, 1.3, 2.9, 4.5)
IDLE, AWAY, HELD = 30, 4, 8  # scans: before the first press, between two, of one
PERIOD_S = 0.05
NOISE, FULL = 5.0, 20_000.0  # counts


class ArraySkin(threading.Thread):
    """Sends until it is stopped; `key`: z or counts."""

    def __init__(
        self, endpoint: str, robot: str, key: str = "z", name: str | int = "arm", idle: int = IDLE
    ) -> None:
        super().__init__(daemon=True)
        self.idle = idle
        self.endpoint, self.robot, self.key, self.named = endpoint, robot, key, name
        self.sent = 0
        self.stops = threading.Event()
        self.model = bundle.load("box", layouts.load(LAYOUT)).model
        self._rng = np.random.default_rng(0)

    def __enter__(self) -> "ArraySkin":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stops.set()
        self.join()

    def run(self) -> None:
        with zmq.Context() as context:
            robot, skin = bound(context, self.robot), bound(context, self.endpoint)
            for at in self._path():
                t = time.time()
                x, y, theta = map(float, se2.compose(TRUTH, at))
                pose = msgpack.packb({"t": t, "x": x, "y": y, "theta": theta})
                robot.send_multipart([b"/robot/sensor_pose", pose, b"%.6f" % t])
                message = {"t": t, "id": self.named, self.key: self.values(at)}
                skin.send_multipart([b"/skin", msgpack.packb(message)])
                self.sent += 1
                if self.stops.wait(PERIOD_S):
                    break
            context.destroy(linger=0)

    def values(self, at: Poses) -> list[float]:
        z: Floats = self.model.activation(se2.inverse(at)[None])[0]
        if self.key == "z":
            return [float(v) for v in z]
        noise = NOISE * self._rng.standard_normal(len(z))
        return [int(v) for v in 3000.0 + FULL * z + noise]

    def _path(self) -> Any:
        """The sensor's poses in the box's frame, without end."""
        yield from [box_side(self.model, 0.0, -0.02)] * self.idle
        while True:
            for angle in ANGLES:
                away = box_side(self.model, angle, -0.02)
                yield from [away] * AWAY
                yield from [box_side(self.model, angle, 0.003)] * HELD
                yield from [away] * AWAY


def bound(context: zmq.Context[Any], endpoint: str) -> zmq.Socket[Any]:
    made = context.socket(zmq.PUB)
    made.setsockopt(zmq.LINGER, 0)
    made.bind(endpoint)
    return made
