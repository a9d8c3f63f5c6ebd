"""An rclpy that stores published messages."""

from tests.support.fake_rclpy import rclpy

__all__ = ["rclpy"]
