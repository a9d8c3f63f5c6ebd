"""Drones as nodes of ROS 2: connect to each drone and set up its topics, services and parameters."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final, Self

from skyloop.client import Drone
from skyloop.client.connect import NAME_TIMEOUT_S, dial_by_name
from skyloop.errors import UsageError
from skyloop.extend import open_unasked
from skyloop.messages import Event, Severity
from skyloop.ros.names import FrameNames, RosTime, namespaces_of
from skyloop.ros.pilot import Pilot, RosParameters
from skyloop.ros.telemetry import RosCameraPublisher, RosTelemetry
from skyloop.vehicles.ros2.node import RosContext, require_rclpy, stay_on_this_machine

PURPOSE: Final = "the bridge to ROS 2"
MESSAGES: Final = ("sensor_msgs.msg", "geometry_msgs.msg", "nav_msgs.srv", "std_srvs.srv", "std_msgs.msg")
UPDATE_S: Final = 0.2  #: interval between checks for subscribers to images
_WAITING: Final = 4  #: maximum number of a drone's services that may wait at the same time


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Options of a bridge.

    Raise ``UsageError`` if a value is out of range, or if two drones have the same name in ROS 2.
    """

    drones: tuple[str, ...]  #: names of running proxies; each becomes a namespace
    #: if set, request control authority immediately with this priority, 0 (highest) to 31; the service uses it too. If
    #: None, only the service requests it, with the default priority.
    priority: int | None = None
    #: the drone hovers if no cmd_vel arrives for this long; must be greater than 0 and at most 5 s
    timeout_s: float = 0.5
    #: a common frame for all drones' ``odom``, if a single simulator or motion capture system locates them; else empty
    map_frame: str = ""
    use_sim_time: bool = False  #: whether to use the time from ``/clock`` for stamps
    domain: int | None = None  #: DDS domain; if None, the domain is taken from ``ROS_DOMAIN_ID``
    #: make the nodes visible to other machines, not only this one, unless the environment configures it
    subnet: bool = False
    arguments: tuple[str, ...] = ()  #: arguments for ROS 2, without ``--ros-args``: ``("-r", "cmd_vel:=teleop")``

    def __post_init__(self) -> None:
        if not self.drones:
            raise UsageError("a bridge to ROS 2 needs at least one drone")
        if not 0.0 < self.timeout_s <= 5.0:
            raise UsageError(f"the time-out of cmd_vel is {self.timeout_s!r} and must be greater than 0, at most 5 s")
        if self.priority is not None and not 0 <= self.priority <= 31:
            raise UsageError(f"priority is {self.priority!r} and must be from 0, the highest, to 31")
        namespaces_of(self.drones)


class Bridge:
    """Connects drones to ROS 2 within a ``with`` block. On exit, it lands the drones that it is flying.

    Raises on entering:
        MissingExtraError: rclpy or a message package is not installed.
        UsageError: ROS 2 rejects its arguments.
        SkyloopError: Connecting to a drone failed or, with ``priority``, the request for authority was refused.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._stack = ExitStack()
        self._cameras: list[RosCameraPublisher] = []
        self.drones: dict[str, Drone] = {}  #: connected drones by name
        self.namespaces = namespaces_of(settings.drones)  #: namespaces by drone name, without a slash

    def __enter__(self) -> Self:
        settings = self._settings
        require_rclpy(PURPOSE, *MESSAGES)
        if not settings.subnet:
            stay_on_this_machine()
        with self._stack:
            context = RosContext(PURPOSE, settings.domain, settings.arguments)
            self._stack.callback(context.close)
            waiting, quick = [], []
            for name, namespace in self.namespaces.items():
                drone = self._stack.enter_context(_connect(name, settings.timeout_s))
                self.drones[name] = drone
                nodes = self._add(context, drone, namespace)
                waiting.append(nodes[0])
                quick.append(nodes[1])
            context.spin(waiting, "ros-services", threads=_WAITING * len(waiting))
            context.spin(quick, "ros-commands")
            self._stack = self._stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, stopping: threading.Event | None = None, shown: Callable[[], object] | None = None) -> None:
        """Serve until the event is set or an exception such as KeyboardInterrupt occurs; call ``shown`` regularly."""
        stopping = stopping or threading.Event()
        while True:
            for camera in self._cameras:
                camera.update()
            if shown is not None:
                shown()
            if stopping.wait(UPDATE_S):
                return

    def _add(self, context: RosContext, drone: Drone, namespace: str) -> tuple[Any, Any]:
        """Set up a drone; return two nodes: the callbacks of one may block, and the callbacks of the other never do."""
        settings = self._settings
        # Nodes must not publish the message type that the transforms borrow and rename (skyloop.ros.names).
        own = {"use_sim_time": settings.use_sim_time, "start_type_description_service": False}
        node = context.node("skyloop", namespace, own)
        topics = context.node("skyloop_commands", namespace, own)
        drone.on_event(lambda event: _log(node, event))
        frames, time = FrameNames(namespace, settings.map_frame), RosTime(node, drone)
        RosParameters(node, drone)
        RosTelemetry(node, drone, time, frames)
        self._cameras += [RosCameraPublisher(node, drone, each, time, frames) for each in drone.capabilities.cameras]
        pilot = Pilot(topics, node, drone, time, frames, priority=settings.priority, timeout_s=settings.timeout_s)
        self._stack.callback(pilot.close)  # close the pilot before disconnecting, because disconnecting lands the drone
        if settings.priority is not None:
            pilot.request_authority()
        return node, topics


def _connect(name: str, timeout_s: float) -> Drone:
    """Connect as a pilot, without requesting control authority yet."""
    return open_unasked(Drone, dial_by_name(name), app="skyloop ros", timeout_s=NAME_TIMEOUT_S, stall_s=timeout_s)


def _log(node: Any, event: Event) -> None:
    logger = node.get_logger()
    if event.severity is Severity.ERROR:
        logger.error(event.text)
    elif event.severity is Severity.WARNING:
        logger.warning(event.text)
    else:
        logger.info(event.text)
