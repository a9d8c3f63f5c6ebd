"""ROS time of what a drone captured."""

from __future__ import annotations

import threading
from typing import Any

from skyloop.client import Drone
from skyloop.vehicles.ros2.wire import ClockMap


class RosTime:
    """Stamps of a drone's samples, on the clock of a node: the system's, or with ``use_sim_time`` that of ``/clock``.

    Args:
        node: Of rclpy.
        drone: Connected.
    """

    def __init__(self, node: Any, drone: Drone) -> None:
        self._clock = node.get_clock()
        self._drone = drone
        self._map = ClockMap()
        self._lock = threading.Lock()

    def stamp_ns(self, captured_ns: int) -> int | None:
        """Return ROS time of a capture on the proxy's clock [ns]; None while there is none. Any thread."""
        with self._lock:
            return self._map.to_ros(captured_ns, self._drone.now_ns, self._clock.now().nanoseconds)

    def age_s(self, stamp_ns: int) -> float:
        """Return how long ago a stamp was [s], by the node's clock."""
        return float(self._clock.now().nanoseconds - stamp_ns) / 1e9
