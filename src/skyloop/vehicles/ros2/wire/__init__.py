"""What a vehicle's state, pictures and times are in messages of ROS 2, both ways. Pure: nothing here needs rclpy."""
