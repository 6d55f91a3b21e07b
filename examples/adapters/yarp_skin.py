"""A YARP port of iCub's skin, compensated, as an array, by YARP's text protocol.

    python yarp_skin.py 10.0.0.2 10042 left_forearm_V2.csv tcp://127.0.0.1:9870

`yarp name query /icub/skin/left_forearm_comp` tells host and port. The file is the layout's, as
`icub_positions.py` makes it.
"""

import json
import socket
import sys
import time

import zmq

from taxeld.layout import read as layouts

FULL = 255.0  # compensated values: 0 at rest
SLOTS = 12  # values of a triangle


def main(host: str, port: int, layout: str, endpoint: str) -> None:
    taxels = [SLOTS * (uid >> 4) + (uid & 0xF) for uid in layouts.read(layout).uid.tolist()]
    with (
        socket.create_connection((host, port)) as line,
        zmq.Context() as context,
        context.socket(zmq.PUB) as to,
    ):
        to.bind(endpoint)
        line.sendall(b"CONNECT taxeld\nr\n")  # a reader from now on
        text = line.makefile(encoding="ascii")
        for head in text:  # do, and an index and a time where the robot stamps them
            if head.split()[:1] == ["do"]:
                values, stamp = text.readline().split(), head.split()[2:]
                t = float(stamp[0]) if stamp else time.time()
                array = {"t": t, "id": "yarp", "z": [float(values[i]) / FULL for i in taxels]}
                to.send(json.dumps(array).encode())


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4])
