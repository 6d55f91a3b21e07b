"""Tell the daemon where the sensor is: a whole publisher of /robot/sensor_pose.

    python publish_pose.py tcp://127.0.0.1:9874

Replace `pose` by what your robot's forward kinematics say. The robot binds and the daemon connects,
so either may start first. Times are Unix seconds (time.time()) of the moment that the pose was
measured, lengths metres, angles radians.
"""

import contextlib
import math
import sys
import time

import msgpack
import zmq

TOPIC = b"/robot/sensor_pose"
RATE_HZ = 100.0  # at least as often as the skin is scanned: 20 times a second by default


def pose(t: float) -> tuple[float, float, float]:
    """x, y and yaw of the sensor frame in the robot's world at the Unix time t."""
    angle = 0.5 * t
    return 0.3 * math.cos(angle), 0.3 * math.sin(angle), 0.0


def main(endpoint: str) -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDHWM, round(RATE_HZ))  # about a second, for a slow subscriber
        try:
            socket.bind(endpoint)
        except zmq.ZMQError as error:
            sys.exit(f"{endpoint}: {error}; stop the program that has it, or name another")
        while True:
            t = time.time()  # when it was measured: not time.monotonic(), and not milliseconds
            x, y, theta = pose(t)
            body = msgpack.packb({"t": t, "x": x, "y": y, "theta": theta})
            socket.send_multipart([TOPIC, body, b"%.6f" % t])
            time.sleep(1.0 / RATE_HZ)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main(sys.argv[1] if len(sys.argv) > 1 else "tcp://127.0.0.1:9874")
