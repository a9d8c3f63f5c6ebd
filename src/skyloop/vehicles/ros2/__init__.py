"""``ros2://`` addresses: any ROS 2 robot with images and ``cmd_vel`` as a vehicle. See ``docs/ros.md``."""
