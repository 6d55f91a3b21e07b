"""MuJoCo's `tactile` sensor as an array: call `send` after each step that is to be a scan.

Readings are depths in metres, one for each vertex of the sensor's mesh; `layout` writes these.
"""

import json
import time

import mujoco
import zmq

FULL_M = 0.005  # depth of an activation of 1: skin.full_scale_depth_m
FULL_Z = 2.0  # deeper ones are cut off


def send(data: mujoco.MjData, sensor: str, to: "zmq.Socket[bytes]", t: float | None = None) -> None:
    """`to`: a PUB socket, bound where the daemon listens (`source.endpoint`); `t`: Unix time of the
    step, which a simulation in real time leaves out."""
    depth_m = data.sensor(sensor).data
    z = [min(float(v) / FULL_M, FULL_Z) for v in depth_m[: len(depth_m) // 3]]  # the rest is slip
    message = {"t": time.time() if t is None else t, "id": sensor, "z": z}
    to.send(json.dumps(message).encode())


def layout(model: mujoco.MjModel, mesh: str) -> str:
    """The text of a layout file, in the mesh's frame."""
    first, number = model.mesh(mesh).vertadr[0], model.mesh(mesh).vertnum[0]
    places = model.mesh_vert[first : first + number]
    rows = [f"{i},{x:.6f},{y:.6f},{z:.6f}" for i, (x, y, z) in enumerate(places)]
    return "\n".join(["uid,x,y,z", *rows]) + "\n"
