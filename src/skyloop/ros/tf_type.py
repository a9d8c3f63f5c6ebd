"""The type ``tf2_msgs/msg/TFMessage`` for rclpy, where no package of it is installed: its publisher is given bytes.

rclpy asks a message's class for a *type support*, a C structure with its name, the hash of its definition and functions
that turn it into bytes (``rosidl_message_type_support_t`` and, of Fast DDS, ``message_type_support_callbacks_t``). A
publisher that is given bytes uses none of the functions but the one for the largest size, which unbounded members make
unknown. So those of another message with such members serve, under the name and the hash of this one.
"""

from __future__ import annotations

import ctypes
import os
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

from skyloop.errors import UnsupportedError
from skyloop.vehicles.ros2.wire import TYPE_HASH, TYPE_NAME

KNOWN_MAJOR: Final = "9"  #: of the package ros-rclpy whose structures these are
_FAST_DDS: Final = b"rosidl_typesupport_fastrtps_c"


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


class _TypeHash(ctypes.Structure):
    """``rosidl_type_hash_t`` of rosidl_runtime_c."""

    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * 32))


_Find = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
_Hash = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_kept: list[Any] = []  # memory that rclpy points into, for as long as this process runs


def tf_message_type() -> type:
    """Return the type of a publisher of transforms that is given the bytes of each message.

    Raises:
        UnsupportedError: No package of it is installed, and this rclpy is none that is known here.
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
    type_hash = _TypeHash(1, (ctypes.c_uint8 * 32).from_buffer_copy(TYPE_HASH))
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
    """Forget what ROS 2 noted on this thread when it looked for functions that this type does not have.

    Otherwise the next note is printed together with that one.
    """
    for line in Path("/proc/self/maps").read_text().splitlines():
        if "/librcutils.so" in line:
            ctypes.CDLL(line.split(maxsplit=5)[5]).rcutils_reset_error()
            return
