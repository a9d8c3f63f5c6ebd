"""An rclpy that keeps what is published."""

from tests.support.fake_rclpy import rclpy

__all__ = ["rclpy"]
