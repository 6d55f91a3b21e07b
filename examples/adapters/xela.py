"""XELA's server as an array: the z counts of all its sensors, in their order.

python xela.py ws://127.0.0.1:5000 tcp://127.0.0.1:9870
"""

import json
import sys

import zmq
from websockets.sync.client import connect


def counts(message: dict) -> dict | None:  # type: ignore[type-arg]
    """An array of a message, whose keys that are numbers are its sensors; None where it has none.
    Each sensor's `data` are x, y and z of each taxel, as hexadecimal counts."""
    sensors = [message[key] for key in sorted(filter(str.isdigit, message), key=int)]
    if not sensors:
        return None
    values = [int(word, 16) for one in sensors for word in one["data"].split(",")[2::3]]
    return {"t": float(sensors[0]["time"]), "id": "xela", "counts": values}


def main(server: str, endpoint: str) -> None:
    with connect(server) as source, zmq.Context() as context, context.socket(zmq.PUB) as to:
        to.bind(endpoint)
        for text in source:
            array = counts(json.loads(text))
            if array is not None:
                to.send(json.dumps(array).encode())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
