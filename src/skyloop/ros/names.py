"""Names of a drone's namespace and frames, as REP 105 wants them. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from skyloop.errors import UsageError
from skyloop.vehicles.ros2.node import ros_name


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of a drone's frames; each begins with the drone's, as several drones share one tree.

    Attributes:
        drone: The drone's name, as ROS 2 allows it.
        map: The frame in which all drones' ``odom`` begin at the same place; empty: there is none.
    """

    drone: str
    map: str = ""

    @property
    def odom(self) -> str:
        """The drone's world axes, x east, y north, z up: continuous, and they may drift."""
        return f"{self.drone}/odom"

    @property
    def base(self) -> str:
        """The body, x forward, y left, z up."""
        return f"{self.drone}/base_link"

    def optical(self, camera: str) -> str:
        """A camera's optical axes, x right, y down, z forward (REP 103: the suffix)."""
        return f"{self.drone}/{ros_name(camera)}_optical_frame"


def namespaces_of(drones: tuple[str, ...]) -> dict[str, str]:
    """Return each drone's namespace, without a slash.

    Raises:
        UsageError: Two drones would have one.
    """
    found: dict[str, str] = {}
    for name in drones:
        namespace = ros_name(name)
        if namespace in found.values():
            other = next(each for each, taken in found.items() if taken == namespace)
            raise UsageError(f"{name} and {other} would both be /{namespace} in ROS 2: serve one under another name")
        found[name] = namespace
    return found
