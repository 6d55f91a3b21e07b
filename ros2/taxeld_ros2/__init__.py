"""taxeld's streams as ROS 2 topics, and ROS 2's transforms as sensor poses (docs/ros2.md).

A process of its own that speaks DDS itself: no ROS is needed to run it. The daemon knows nothing of
it.
"""
