"""The only place that creates ROS 2 nodes. rclpy is optional and is imported with the first node.

Because ROS 2 has no access control, nodes are visible only on this machine unless the environment configures discovery.
"""

from __future__ import annotations

import atexit
import os
import re
import tempfile
import threading
from collections.abc import Iterable, Mapping, MutableMapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from skyloop.errors import MissingExtraError, UsageError

#: Environment variables that configure discovery; if any of them is set, discovery is left as configured.
DISCOVERY_VARIABLES: Final = (
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_LOCALHOST_ONLY",
    "ROS_DISCOVERY_SERVER",
)
#: Environment variables for the path of a profile, for Fast DDS 3 and for Fast DDS 2 (Jazzy and earlier).
PROFILES_VARIABLE, OLD_PROFILES_VARIABLE = DISCOVERY_VARIABLES[:2]
_OLD_DISTRIBUTIONS: Final = ("humble", "iron", "jazzy")
_FIRST_WITH_FAST_DDS_3: Final = 8  #: first major version of rclpy with Fast DDS 3
MOST_DOMAIN: Final = 101  #: maximum domain: above it, outgoing connections on Linux may occupy DDS's ports
SHARED_BYTES: Final = 16 * 2**20  #: shared memory per participant: several images; the default 512 KiB is too small

#: A profile for Fast DDS: sockets only on loopback, and shared memory large enough for images.
LOOPBACK_PROFILE: Final = f"""<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com">
  <profiles>
    <transport_descriptors>
      <transport_descriptor>
        <transport_id>skyloop_loopback</transport_id>
        <type>UDPv4</type>
        <interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>
      </transport_descriptor>
      <transport_descriptor>
        <transport_id>skyloop_shared_memory</transport_id>
        <type>SHM</type>
        <segment_size>{SHARED_BYTES}</segment_size>
      </transport_descriptor>
    </transport_descriptors>
    <participant profile_name="skyloop" is_default_profile="true">
      <rtps>
        <userTransports>
          <transport_id>skyloop_shared_memory</transport_id>
          <transport_id>skyloop_loopback</transport_id>
        </userTransports>
        <useBuiltinTransports>false</useBuiltinTransports>
      </rtps>
    </participant>
  </profiles>
</dds>
"""


def require_rclpy(purpose: str, *packages: str) -> Any:
    """Import rclpy and message packages; return rclpy. If a package is missing, the error states the purpose."""
    from importlib import import_module

    try:
        for package in packages:
            import_module(package)
        return import_module("rclpy")
    except ImportError as error:
        raise MissingExtraError(purpose, "ros", cause=str(error)) from error


def stay_on_this_machine(environment: MutableMapping[str, str] = os.environ) -> bool:
    """Make this process's nodes visible only on this machine, unless the environment configures discovery.

    Call this before creating the first node. Returns whether the environment was changed, by this call or, for Fast
    DDS, by an earlier one. Fast DDS reads a profile from a temporary directory that is removed at exit.
    """
    if any(environment.get(variable) for variable in DISCOVERY_VARIABLES):
        return bool(_profile) and _profile["path"] in map(environment.get, DISCOVERY_VARIABLES[:2])
    if environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") != "rmw_fastrtps_cpp":
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # setting for other DDS implementations
        return True
    folder = tempfile.TemporaryDirectory(prefix="skyloop-ros-")
    atexit.register(folder.cleanup)
    path = Path(folder.name) / "loopback.xml"
    path.write_text(LOOPBACK_PROFILE)
    variable = OLD_PROFILES_VARIABLE if _has_fast_dds_2(environment) else PROFILES_VARIABLE
    environment[variable] = _profile["path"] = str(path)
    return True


_profile: dict[str, str] = {}  # path of the profile that was written


def _has_fast_dds_2(environment: Mapping[str, str]) -> bool:
    try:
        return int(version("ros-rclpy").partition(".")[0]) < _FIRST_WITH_FAST_DDS_3
    except (PackageNotFoundError, ValueError):  # installed by a ROS 2 distribution
        return environment.get("ROS_DISTRO", "") in _OLD_DISTRIBUTIONS


def domain_of(text: str | None) -> int | None:
    """Parse a domain; return None if there is no text, in which case ROS 2 uses ``ROS_DOMAIN_ID``."""
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and int(text) <= MOST_DOMAIN):
        raise UsageError(f"the ROS 2 domain is {text!r} but must be a number from 0 to {MOST_DOMAIN}")
    return int(text)


def ros_name(name: str) -> str:
    """Return a valid ROS 2 name for a namespace or frame: letters, digits and ``_``, not starting with a digit."""
    word = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"drone_{word}" if not word or word[0].isdigit() else word


class RosContext:
    """An rclpy context, its nodes, and the threads that run their callbacks.

    ``domain`` is None to use ``ROS_DOMAIN_ID``; ``arguments`` are those of ROS 2, such as ``-r cmd_vel:=/cmd_vel``,
    without ``--ros-args``. Raises :class:`MissingExtraError`, stating the purpose, if rclpy is missing, and
    :class:`UsageError` if it rejects the arguments.
    """

    def __init__(self, purpose: str, domain: int | None = None, arguments: Iterable[str] = ()) -> None:
        self._rclpy = require_rclpy(purpose)
        self._context = self._rclpy.Context()
        # Logs go to standard error and /rosout. By default, rclpy also writes a file per run to the home directory.
        words = ["--ros-args", "--disable-external-lib-logs", *arguments]
        try:
            self._rclpy.init(args=words, context=self._context, domain_id=domain, signal_handler_options=_no_signals())
        except Exception as error:
            raise UsageError(f"ROS 2 can't start with {' '.join(words)}: {error}") from error
        self._nodes: list[Any] = []
        self._executors: list[tuple[Any, threading.Thread]] = []

    def node(self, name: str, namespace: str = "", parameters: Mapping[str, bool | int | float | str] = {}) -> Any:
        """Create a node with these initial parameter values."""
        overrides = [self._rclpy.Parameter(key, value=value) for key, value in parameters.items()]
        node = self._rclpy.create_node(
            name, namespace=namespace, context=self._context, parameter_overrides=overrides, enable_logger_service=False
        )
        self._nodes.append(node)
        return node

    def spin(self, nodes: Iterable[Any], name: str, threads: int = 1) -> None:
        """Run the nodes' callbacks on the given number of threads until :meth:`close`."""
        from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor

        executor: Any = (
            SingleThreadedExecutor(context=self._context)
            if threads == 1
            else MultiThreadedExecutor(threads, context=self._context)
        )
        for node in nodes:
            executor.add_node(node)

        def run() -> None:
            try:
                executor.spin()
            except ExternalShutdownException:
                return  # the context was shut down normally

        thread = threading.Thread(target=run, name=name, daemon=True)
        self._executors.append((executor, thread))
        thread.start()

    def close(self) -> None:
        """End the threads and the nodes. Idempotent."""
        executors, self._executors = self._executors, []
        for executor, thread in executors:
            executor.shutdown(timeout_sec=5.0)
            thread.join(5.0)
        nodes, self._nodes = self._nodes, []
        for node in nodes:
            node.destroy_node()
        if self._context.ok():
            self._rclpy.shutdown(context=self._context)
        self._context.destroy()


def _no_signals() -> Any:
    from rclpy.signals import SignalHandlerOptions

    return SignalHandlerOptions.NO
