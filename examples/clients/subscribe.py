"""The smallest subscriber: print where the object is whenever a touch has ended."""

import argparse
import os
import sys
from pathlib import Path

import msgpack
import zmq

CONVERGED = 3  # of `status`: docs/stream.md has all numbers

own = Path(os.environ.get("XDG_RUNTIME_DIR", "/nowhere"), "taxeld", "stream")
default = f"ipc://{own if own.exists() else '/run/taxeld/stream'}"
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("endpoint", nargs="?", default=default, help="(default: %(default)s)")
socket = zmq.Context().socket(zmq.SUB)
endpoint = parser.parse_args().endpoint
try:
    socket.connect(endpoint)
except zmq.ZMQError as error:
    sys.exit(f"{endpoint}: {error}; use ipc:///path or tcp://host:port")
socket.setsockopt(zmq.SUBSCRIBE, b"/taxeld/estimate")
print(f"listening at {endpoint}", file=sys.stderr)
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
