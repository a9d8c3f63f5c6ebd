"""Options in a ``tello://`` address, listed in ``docs/tello.md``. Pure."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.live_camera import INTRINSICS_OPTIONS, check_intrinsics
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UnknownNameError, UsageError
from skyloop.vehicles.tello.wire import PORT, STATE_PORT, VIDEO_PORT

_HOST: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,252}[A-Za-z0-9])?\Z")
_INTERFACE: Final = re.compile(r"[A-Za-z0-9_.:@-]{1,15}\Z")
MOST_CONCEALED: Final = 30  #: number of images from one key frame to the next
_LEAST_PORT: Final = 1025  # lowest port that the Tello's command accepts
KNOWN: Final = {
    *("local", "interface", "port", "state_port", "video_port", "video", "concealed", "pads", "velocity_axes"),
    *INTRINSICS_OPTIONS,
}


class VelocityAxes(StrEnum):
    """Possible axes of the drone's ``vgx`` and ``vgy``, which the SDK's guides do not specify."""

    START = "start"  #: x along the heading when switched on
    BODY = "body"  #: x along the drone's nose
    NONE = "none"  #: ignore the values, so that feedback has no velocity


@dataclass(frozen=True, slots=True)
class TelloOptions:
    """The contents of a parsed ``tello://`` address."""

    host: str
    local: str | None = None  #: this host's address for sending and receiving
    interface: str | None = None  #: this host's network interface
    port: int = PORT
    state_port: int = STATE_PORT
    video_port: int = VIDEO_PORT
    video: bool = True
    concealed: int = 0  #: maximum number of damaged images on which a displayed one may depend
    pads: bool = False  #: whether to detect mission pads from the start
    velocity_axes: VelocityAxes = VelocityAxes.START

    @property
    def own_ports(self) -> bool:
        """Whether a command must set the ports to which the drone sends state and video."""
        return (self.state_port, self.video_port) != (STATE_PORT, VIDEO_PORT)


def options_of(uri: VehicleUri) -> TelloOptions:
    reject_unknown_options(uri, KNOWN)
    if not uri.place:
        raise UsageError(f"{uri} names no host; it should look like tello://192.168.10.1")
    if not _HOST.match(uri.place):
        hint = "; the port is given as an option: ?port=8889" if ":" in uri.place else ""
        raise UsageError(f"{uri}: {uri.place!r} is not the name or IPv4 address of a host{hint}")
    check_intrinsics(uri)
    axes = uri.options.get("velocity_axes", VelocityAxes.START)
    if axes not in list(VelocityAxes):
        raise UnknownNameError("velocity_axes of tello://", axes, [known.value for known in VelocityAxes])
    made = TelloOptions(
        host=uri.place,
        local=_local(uri),
        interface=_interface(uri),
        port=uri.whole("port", PORT, minimum=1, maximum=65535),
        state_port=uri.whole("state_port", STATE_PORT, minimum=_LEAST_PORT, maximum=65535),
        video_port=uri.whole("video_port", VIDEO_PORT, minimum=_LEAST_PORT, maximum=65535),
        video=uri.flag("video", default=True),
        concealed=uri.whole("concealed", 0, maximum=MOST_CONCEALED),
        pads=uri.flag("pads", default=False),
        velocity_axes=VelocityAxes(axes),
    )
    if made.state_port == made.video_port:
        raise UsageError(f"{uri}: state and video can't share port {made.state_port}")
    return made


def _local(uri: VehicleUri) -> str | None:
    given = uri.options.get("local")
    if given is None:
        return None
    try:
        return str(ipaddress.IPv4Address(given))
    except ValueError:
        raise UsageError(
            f"{uri}: local is {given!r} and must be an IPv4 address of this host; an interface is named by interface="
        ) from None


def _interface(uri: VehicleUri) -> str | None:
    given = uri.options.get("interface")
    if given is not None and not _INTERFACE.match(given):
        raise UsageError(f"{uri}: interface is {given!r} and must be the name of a network interface, such as wlan1")
    return given
