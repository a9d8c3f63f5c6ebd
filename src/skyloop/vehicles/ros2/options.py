"""Options in a ``ros2://`` address, listed in ``docs/ros.md``. Pure."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import CameraInfo, Capabilities, Encoding
from skyloop.messages.frame import LOOKING_DOWN, LOOKING_FORWARD, Rotation9
from skyloop.vehicles.ros2.node import MOST_DOMAIN

#: Default topics by the option that names them; names without a leading slash are relative to the namespace.
TOPICS: Final = {"image": "image_raw", "cmd_vel": "cmd_vel", "odom": "odom", "battery": "battery_state"}
SERVICES: Final = ("takeoff", "land")
_OTHERS: Final = (
    "info",
    "camera",
    "mount",
    "width",
    "height",
    "fps",
    "compressed",
    "stamped",
    "ground",
    "timeout",
    "domain",
)
KNOWN: Final = {*TOPICS, *SERVICES, *_OTHERS}
_NAME: Final = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*\Z", re.ASCII)
#: Camera mounts: the camera's optical axes (x right, y down, z forward) in body axes, row by row.
MOUNTS: Final[dict[str, Rotation9 | None]] = {
    "ahead": LOOKING_FORWARD,
    "down": LOOKING_DOWN,
    "unknown": None,
}


@dataclass(frozen=True, slots=True)
class Options:
    """Full names of a robot's topics and services (empty if the robot lacks them), and the other options."""

    namespace: str  #: namespace with a leading slash
    image: str  #: ``sensor_msgs/Image``, or ``CompressedImage`` if ``compressed``
    info: str  #: ``sensor_msgs/CameraInfo``
    cmd_vel: str  #: ``geometry_msgs/Twist``, or ``TwistStamped`` if ``stamped``
    odom: str  #: ``nav_msgs/Odometry``
    battery: str  #: ``sensor_msgs/BatteryState``
    takeoff: str  #: ``std_srvs/Trigger``
    land: str  #: ``std_srvs/Trigger``
    camera: str  #: name of the camera
    mount: str  #: a name in :data:`MOUNTS`
    width: int  #: image width [px]
    height: int  #: [px]
    fps: float  #: frame rate [1/s]
    compressed: bool  #: whether images are JPEG
    stamped: bool  #: whether velocities have a stamp
    ground: bool  #: whether the robot is a ground vehicle, for which take-off and landing start and end the drive
    timeout_s: float  #: time without data after which the link counts as lost [s]
    domain: int | None  #: DDS domain; None to use ``ROS_DOMAIN_ID``

    def capabilities(self) -> Capabilities:
        actions: set[str] = set()
        if self.cmd_vel:
            actions = {"idle", "velocity"}
            if self.ground:
                actions |= {"takeoff", "hover", "land"}
            actions |= {name for name in SERVICES if getattr(self, name)}
        camera = CameraInfo(
            self.camera,
            self.width,
            self.height,
            self.fps,
            Encoding.JPEG if self.compressed else Encoding.BGR8,
            rotation=MOUNTS[self.mount],
        )
        return Capabilities(
            vehicle="ros2",
            actions=frozenset(actions),
            cameras=(camera,) if self.image else (),
            why_not="" if actions else "the address names no cmd_vel",
            description=f"a ROS 2 robot below {self.namespace}" + (", a ground vehicle" if self.ground else ""),
        )


def options_of(uri: VehicleUri) -> Options:
    reject_unknown_options(uri, KNOWN)
    namespace = f"/{uri.place.strip('/')}" if uri.place.strip("/") else ""
    if namespace and not _NAME.match(namespace):
        raise UsageError(f"{uri}: {uri.place!r} is not a ROS 2 namespace: letters, digits and _, no digit first")

    def name(option: str, default: str = "") -> str:
        given = uri.options.get(option, default)
        if given and not _NAME.match(given):
            raise UsageError(f"{uri}: option {option} is {given!r} but must be a ROS 2 name, or empty for none")
        return given if given.startswith("/") or not given else f"{namespace}/{given}"

    topics = {option: name(option, default) for option, default in TOPICS.items()}
    if not topics["image"] and not topics["odom"]:
        raise UsageError(f"{uri}: without image and odom the robot would send no data: name at least one")
    ground = uri.flag("ground")
    services = {option: name(option) for option in SERVICES}
    for option, service in services.items():
        if service and (ground or not topics["cmd_vel"]):
            reason = "a robot with ground=1 does not leave the ground" if ground else "it needs cmd_vel as well"
            raise UsageError(f"{uri}: option {option} makes no sense: {reason}")
    camera = uri.options.get("camera", "front")
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,32}", camera):
        raise UsageError(f"{uri}: option camera is {camera!r} but must be a name of 1 to 32 letters, digits, _ or -")
    mount = uri.options.get("mount", "ahead")
    if mount not in MOUNTS:
        raise UnknownNameError(f"mount of a camera of {uri.scheme}://", mount, MOUNTS)
    return Options(
        namespace=namespace or "/",
        **topics,
        **services,
        info=name("info", f"{topics['image'].rpartition('/')[0]}/camera_info" if topics["image"] else ""),
        camera=camera,
        mount=mount,
        width=uri.whole("width", 640, minimum=1, maximum=8192),
        height=uri.whole("height", 480, minimum=1, maximum=8192),
        fps=uri.number("fps", 30.0, minimum=0.1, maximum=1000.0),
        compressed=uri.flag("compressed"),
        stamped=uri.flag("stamped"),
        ground=ground,
        timeout_s=uri.number("timeout", 1.0, minimum=0.1, maximum=60.0),
        domain=uri.whole("domain", 0, maximum=MOST_DOMAIN) if "domain" in uri.options else None,
    )
