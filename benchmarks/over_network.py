"""Skyloop's own ends over the network, on hosts that share only a path."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np

from benchmarks.measuring import ours
from benchmarks.measuring.contract import Image
from benchmarks.measuring.schedule import SMALL
from skyloop.bench import Setpoint
from skyloop.client import Drone
from skyloop.client import connect as connect_by_name
from skyloop.client.drone import Access
from skyloop.client.video import VideoOptions
from skyloop.errors import LinkError, SkyloopError, UnknownNameError
from skyloop.messages import Encoding, FrameHeader
from skyloop.messages.subscription import VideoRequest
from skyloop.network import FabricServer, FabricSettings
from skyloop.network.config import LEASE_S
from skyloop.transport.base import TransportServer

JPEG: Final = VideoOptions(encoding="jpeg", quality=80)
_JPEGS: Final = 50
_CONNECTS_WITHIN_S: Final = 20.0


def address(name: str, *places: str, listens: bool = True) -> str:
    """Return the address for both ends of a contender.

    Args:
        name: The proxy's name.
        *places: Addresses as for :class:`FabricSettings`; applications connect to all of them.
        listens: Whether the proxy listens on the first one; otherwise it connects to all, too.
    """
    return json.dumps([name, places, listens])


def settings_of(address: str, *, serves: bool) -> tuple[str, FabricSettings]:
    """Return the name in an address from :func:`address`, and the network settings of the proxy or an application."""
    name, places, listens = json.loads(address)
    if serves and listens:
        return name, FabricSettings(listen=tuple(places[:1]), multicast=False)
    return name, FabricSettings(connect=tuple(places), multicast=False)


class Vehicle(ours.Vehicle):
    """The vehicle's end, whose frames are a photo-like picture instead of noise."""

    def _server(self, address: str) -> tuple[str, TransportServer]:
        name, settings = settings_of(address, serves=True)
        return name, FabricServer(name, settings)

    def frame(self, sent_ns: int, image: Image) -> None:  # noqa: ARG002  (noise would make the longest JPEGs)
        """Send the picture instead of noise, which would make the longest JPEGs."""
        super().frame(sent_ns, scenery())


class Application(ours.Application):
    """The pilot, who continues while the link is lost, like a controller."""

    video = JPEG

    def _connect(self, address: str) -> Drone:
        return connect(address)

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        """Send a command; if that fails, it counts as lost."""
        try:
            super().command(sent_ns, setpoint)
        except SkyloopError:  # not sent, so not executed: counted as lost
            return


class Pilot(Application):
    """A pilot who flies without video."""

    looks = False


def connect(address: str, access: Access = "pilot", *, lease_s: float = LEASE_S) -> Drone:
    """Connect to a drone over the network, retrying for a while on a busy machine.

    Raises:
        LinkError: The drone did not answer.
        UnknownNameError: The drone was not found.
    """
    name, settings = settings_of(address, serves=False)
    settings = replace(settings, lease_s=lease_s)
    deadline = time.monotonic() + _CONNECTS_WITHIN_S
    while True:
        try:
            return connect_by_name(
                name, access=access, name="bench", on_exit="hover", network=settings, timeout_s=_CONNECTS_WITHIN_S
            )
        except (LinkError, UnknownNameError):
            if time.monotonic() > deadline:
                raise


@cache
def scenery() -> Image:
    """Return a picture as detailed as a camera's in a room: at JPEG quality 80 it has about 14 kB."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(30, 225, (SMALL.height // 20, SMALL.width // 20, 3))
    image = np.kron(coarse, np.ones((20, 20, 1))) + rng.normal(0.0, 4.0, (SMALL.height, SMALL.width, 3))
    picture: Image = np.clip(image, 0, 255).astype(np.uint8)
    return picture


def jpeg_us() -> float:
    """Return the processor time to encode that picture [µs]."""
    from skyloop.transport.frame_encoding import encode_frame

    picture = scenery()
    header = FrameHeader("bench", 1, 0, 0, SMALL.width, SMALL.height, Encoding.BGR8, picture.nbytes)
    pixels, request = picture.reshape(-1), VideoRequest("bench", encoding="jpeg", quality=JPEG["quality"])
    encode_frame(header, pixels, request)
    begin_ns = time.process_time_ns()
    for _ in range(_JPEGS):
        encode_frame(header, pixels, request)
    return (time.process_time_ns() - begin_ns) / _JPEGS / 1e3
