"""The smallest subscriber: print where the object is whenever a touch has ended."""

import sys

import msgpack
import zmq

endpoint = sys.argv[1] if len(sys.argv) > 1 else "ipc:///run/taxeld/stream"
socket = zmq.Context().socket(zmq.SUB)
socket.connect(endpoint)
socket.setsockopt(zmq.SUBSCRIBE, b"/taxeld/estimate")
touching = False
while True:
    _topic, body, *_time = socket.recv_multipart()
    estimate = msgpack.unpackb(body)
    if touching and not estimate["contact"] and estimate["valid"]:
        pose, weight = estimate["map"], estimate["modes"][0]["weight"]
        print(f"x {pose['x']:.3f} m  y {pose['y']:.3f} m  yaw {pose['theta']:.2f}  ({weight:.0%})")
    touching = estimate["contact"]
