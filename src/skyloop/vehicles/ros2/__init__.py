"""Driver of ``ros2://``: any robot of ROS 2 with images and ``cmd_vel`` is a vehicle. ``docs/ros.md``."""
