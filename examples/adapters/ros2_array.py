"""A ROS 2 topic of std_msgs/Float32MultiArray as an array of counts, by DDS without ROS.

python ros2_array.py cyskin/timeseries_data tcp://127.0.0.1:9870
"""

import json
import sys
import time

import zmq
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import float32, sequence, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

ROS = "std_msgs::msg::dds_::"
SIZES = {"label": str, "size": uint32, "stride": uint32}
Dimension = make_idl_struct("MultiArrayDimension_", f"{ROS}MultiArrayDimension_", SIZES)
PLACES = {"dim": sequence[Dimension], "data_offset": uint32}
Places = make_idl_struct("MultiArrayLayout_", f"{ROS}MultiArrayLayout_", PLACES)
VALUES = {"layout": Places, "data": sequence[float32]}
Values = make_idl_struct("Float32MultiArray_", f"{ROS}Float32MultiArray_", VALUES)
CDR = Qos(Policy.DataRepresentation(use_cdrv0_representation=True), Policy.History.KeepLast(10))


def main(name: str, endpoint: str) -> None:
    at = DomainParticipant(int(sys.argv[3]) if len(sys.argv) > 3 else 0)
    reader = DataReader(at, Topic(at, f"rt/{name}", Values), qos=CDR)
    with zmq.Context() as context, context.socket(zmq.PUB) as to:
        to.bind(endpoint)
        for values in reader.take_iter(timeout=duration(infinite=True)):
            message = {"t": time.time(), "id": name, "counts": list(values.data)}
            to.send(json.dumps(message).encode())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
