"""Driver of ``ros2://``: any ROS 2 robot with images and ``cmd_vel`` as a vehicle. ``docs/ros.md``."""
