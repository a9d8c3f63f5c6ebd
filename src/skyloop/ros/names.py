"""Names, times and types as ROS 2 requires them: a drone's namespace and frames (REP 105), time, and transforms' type.

rclpy lacks ``tf2_msgs/msg/TFMessage`` if that message's package is not installed, so the publisher sends ready-made
bytes. rclpy gets a *type support* from a message's class: a C structure with the message's name, the hash of its
definition, and functions that serialise it (``rosidl_message_type_support_t`` and, for Fast DDS,
``message_type_support_callbacks_t``). A publisher of bytes calls only the function that returns the largest size, which
is unknown for unbounded members. Another such message's functions therefore work with the name and hash of this one.
"""

from __future__ import annotations

import ctypes
import os
import threading
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from skyloop.client import Drone
from skyloop.errors import UnsupportedError, UsageError
from skyloop.vehicles.ros2.node import ros_name
from skyloop.vehicles.ros2.wire import TYPE_HASH, TYPE_NAME, ClockMap

KNOWN_MAJOR: Final = "9"  #: version of the package ros-rclpy that has these structures
_FAST_DDS: Final = b"rosidl_typesupport_fastrtps_c"


@dataclass(frozen=True, slots=True)
class FrameNames:
    """Names of a drone's frames. Each one begins with the drone's name, because several drones share one tree."""

    drone: str  #: the drone's name, as a valid ROS 2 name
    map: str = ""  #: the frame in which the ``odom`` frames of all drones have the same origin; empty for none

    @property
    def odom(self) -> str:
        """The drone's world axes, x east, y north, z up; the frame is continuous, but may drift."""
        return f"{self.drone}/odom"

    @property
    def base(self) -> str:
        """The drone's body axes: x forward, y left, z up."""
        return f"{self.drone}/base_link"

    def optical(self, camera: str) -> str:
        """Return the name of a camera's optical axes, x right, y down, z forward (the suffix comes from REP 103)."""
        return f"{self.drone}/{ros_name(camera)}_optical_frame"


def namespaces_of(drones: tuple[str, ...]) -> dict[str, str]:
    """Return each drone's namespace, without a slash."""
    found: dict[str, str] = {}
    for name in drones:
        namespace = ros_name(name)
        if namespace in found.values():
            other = next(each for each, taken in found.items() if taken == namespace)
            raise UsageError(f"{name} and {other} would both be /{namespace} in ROS 2: serve one under another name")
        found[name] = namespace
    return found


class RosTime:
    """Stamps a drone's samples on a node's clock: the system clock or, with ``use_sim_time``, that of ``/clock``."""

    def __init__(self, node: Any, drone: Drone) -> None:
        self._clock = node.get_clock()
        self._drone = drone
        self._map = ClockMap()
        self._lock = threading.Lock()

    def stamp_ns(self, captured_ns: int) -> int | None:
        """Return the ROS time of a capture time on the proxy's clock [ns], or None if there is none. Any thread."""
        with self._lock:
            return self._map.to_ros(captured_ns, self._drone.now_ns, self._clock.now().nanoseconds)

    def age_s(self, stamp_ns: int) -> float:
        """Return a stamp's age according to the node's clock [s]."""
        return float(self._clock.now().nanoseconds - stamp_ns) / 1e9


class _TypeSupport(ctypes.Structure):
    """``rosidl_message_type_support_t`` of rosidl_runtime_c."""

    _fields_ = (
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("find", ctypes.c_void_p),
        ("hash", ctypes.c_void_p),
        ("description", ctypes.c_void_p),
        ("sources", ctypes.c_void_p),
    )


class _Callbacks(ctypes.Structure):
    """``message_type_support_callbacks_t`` of rosidl_typesupport_fastrtps_cpp."""

    _fields_ = (
        ("namespace", ctypes.c_char_p),
        ("name", ctypes.c_char_p),
        ("serialize", ctypes.c_void_p),
        ("deserialize", ctypes.c_void_p),
        ("size", ctypes.c_void_p),
        ("largest_size", ctypes.c_void_p),
        ("keys", ctypes.c_void_p),
    )


_Find = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
_Hash = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_kept: list[Any] = []  # memory to which rclpy keeps pointers for the lifetime of this process


def tf_message_type() -> type:
    """Return a type for a publisher of transforms that sends ready-made bytes.

    Raise ``UnsupportedError`` if the message's package is not installed, and this version of rclpy is not supported.
    """
    try:
        installed: type = import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return _kept[0] if _kept else _borrowed()
    return installed


def _borrowed() -> type:
    try:
        major = version("ros-rclpy").partition(".")[0]
    except PackageNotFoundError:
        major = "a distribution's"
    implementation = os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    if major != KNOWN_MAJOR or implementation != "rmw_fastrtps_cpp":
        raise UnsupportedError(
            f"there is no package tf2_msgs here, and transforms are published without it only by ros-rclpy "
            f"{KNOWN_MAJOR}.x with rmw_fastrtps_cpp, not {major}.x with {implementation}"
        )
    from geometry_msgs.msg import TransformStamped

    lender: Any = TransformStamped.__class__
    lender.__import_type_support__()
    python = ctypes.pythonapi
    python.PyCapsule_GetName.restype, python.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    python.PyCapsule_GetPointer.restype = ctypes.c_void_p
    python.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    python.PyCapsule_New.restype = ctypes.py_object
    python.PyCapsule_New.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    capsule_name = python.PyCapsule_GetName(lender._TYPE_SUPPORT)
    handle = python.PyCapsule_GetPointer(lender._TYPE_SUPPORT, capsule_name)
    found = _Find(_TypeSupport.from_address(handle).find)(handle, _FAST_DDS)
    if not found or _TypeSupport.from_address(found).identifier != _FAST_DDS:
        raise UnsupportedError("geometry_msgs has no type support for Fast DDS: pip install ros-rmw-fastrtps-cpp")
    callbacks = _Callbacks.from_buffer_copy(_Callbacks.from_address(_TypeSupport.from_address(found).data))
    package, _, name = TYPE_NAME.rpartition("/")
    callbacks.namespace, callbacks.name = package.replace("/", "::").encode(), name.encode()
    support = _TypeSupport.from_buffer_copy(_TypeSupport.from_address(found))
    support.data = ctypes.addressof(callbacks)
    type_hash = ctypes.create_string_buffer(b"\x01" + TYPE_HASH, 33)  # rosidl_type_hash_t: version and 32 bytes
    address = ctypes.addressof(type_hash)
    get_hash = _Hash(lambda _: address)
    support.hash = ctypes.cast(get_hash, ctypes.c_void_p).value
    capsule = python.PyCapsule_New(ctypes.addressof(support), capsule_name, None)
    functions = ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE")
    borrowed = {each: getattr(lender, each) for each in functions}
    metaclass = type("Metaclass_TFMessage", (type,), {**borrowed, "_TYPE_SUPPORT": capsule})
    made: type = metaclass(name, (), {})
    _kept.extend((made, callbacks, support, type_hash, get_hash, capsule))
    return made


def forget_error() -> None:
    """Clear the error that ROS 2 stored on this thread when it looked for functions missing from the type.

    Otherwise, ROS 2 prints this error together with the next one.
    """
    for line in Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines():
        if "/librcutils.so" in line:
            ctypes.CDLL(line.split(maxsplit=5)[5]).rcutils_reset_error()
            return
