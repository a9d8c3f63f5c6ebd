"""Driver of ``ros2://``: any robot of ROS 2 with images and ``cmd_vel`` is a vehicle. ``docs/ros.md``."""

from skyloop.vehicles.ros2.driver import Ros2Driver

__all__ = ["Ros2Driver"]
