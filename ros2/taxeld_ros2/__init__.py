"""The bridge between a daemon and ROS 2 (docs/ros2.md): it speaks DDS itself and needs no ROS."""
