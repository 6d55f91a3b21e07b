"""The smallest subscriber: print where the object is whenever a touch has ended.

It needs `pip install pyzmq msgpack`.
"""

import argparse
import os
import sys

import msgpack
import zmq

CONVERGED = 3  # of `status`: docs/stream.md has all numbers

# of the service, and of a daemon that this user runs: whichever is there, or comes later
usual = [
    "ipc:///run/taxeld/stream",
    f"ipc://{os.environ.get('XDG_RUNTIME_DIR', '/nowhere')}/taxeld/stream",
]
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("endpoint", nargs="*", default=usual, help="(default: %(default)s)")
socket = zmq.Context().socket(zmq.SUB)
for endpoint in parser.parse_args().endpoint:
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        sys.exit(f"{endpoint}: {error}; use ipc:///path or tcp://host:port")
    print(f"listening at {endpoint}", file=sys.stderr)
socket.setsockopt(zmq.SUBSCRIBE, b"/taxeld/estimate")
touching = False
while True:
    _topic, body, *_time = socket.recv_multipart()
    estimate = msgpack.unpackb(body)
    is_usable = estimate["valid"] and estimate["status"] == CONVERGED
    if touching and not estimate["contact"] and is_usable:
        pose, p = estimate["map"], estimate["p"]
        named = max(estimate["objects"], key=estimate["objects"].get)
        at = f"x {pose['x']:.3f} m  y {pose['y']:.3f} m  yaw {pose['theta']:.2f}"
        print(f"{at}  p {p:.3f}  {named}")
    touching = estimate["contact"]
