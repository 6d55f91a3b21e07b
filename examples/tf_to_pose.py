"""Publish a frame of tf as geometry_msgs/msg/PoseStamped, for taxeld-ros2 --sensor-topic.

    python3 tf_to_pose.py WORLD SKIN /arm/skin

It needs ROS 2 with rclpy and tf2_ros.
"""

import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.time import Time
from tf2_ros import Buffer, TransformException, TransformListener

world, skin, topic = sys.argv[1:4]
rclpy.init()
node = rclpy.create_node("tf_to_pose")
buffer, last = Buffer(), PoseStamped()
listener = TransformListener(buffer, node)
publisher = node.create_publisher(PoseStamped, topic, 10)


def publish() -> None:
    """Publish the newest transform once."""
    try:
        found = buffer.lookup_transform(world, skin, Time())
    except TransformException as error:
        node.get_logger().warning(str(error), throttle_duration_sec=5.0)
        return
    if found.header.stamp != last.header.stamp:
        at, last.header = found.transform.translation, found.header
        last.pose.position.x, last.pose.position.y, last.pose.position.z = at.x, at.y, at.z
        last.pose.orientation = found.transform.rotation
        publisher.publish(last)


node.create_timer(0.005, publish)
rclpy.spin(node)
