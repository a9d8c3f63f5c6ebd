"""Skyloop's own ends: a proxy with a vehicle that only makes samples, and an application's drone."""

from __future__ import annotations

from pathlib import Path

from skyloop.bench.contract import Image, Received
from skyloop.bench.schedule import FEEDBACK, VIDEO
from skyloop.bench.vehicle import CAMERA, USUAL_CAMERA, BenchVehicle, stamped
from skyloop.bench.waypoints import Setpoint
from skyloop.client import Drone, Frame, connect
from skyloop.client.channels import VideoOptions
from skyloop.messages import EncodedFrame, Feedback
from skyloop.proxy import Proxy
from skyloop.proxy.warm_up import keep_warm
from skyloop.transport.base import TransportServer
from skyloop.transport.local import LocalServer


def proxy_name(address: str) -> str:
    """Return the name of the proxy that is measured.

    Args:
        address: A folder of this run alone.
    """
    return Path(address).name.lower()


class Vehicle:
    """The vehicle's end; see :class:`skyloop.bench.contract.VehicleEnd`."""

    camera = USUAL_CAMERA

    def __init__(self, address: str, received: Received) -> None:
        name, server = self._server(address)
        self._vehicle = BenchVehicle(received, self.camera)
        self._proxy = Proxy(self._vehicle, server, name=name)
        keep_warm(self._proxy)
        self._proxy.start()

    def _server(self, address: str) -> tuple[str, TransportServer]:
        """What it is called, and where it serves."""
        name = proxy_name(address)
        return name, LocalServer(name)

    def feedback(self, sent_ns: int) -> None:
        self._vehicle.publish_feedback(sent_ns)

    def frame(self, sent_ns: int, image: Image) -> None:
        self._vehicle.show(sent_ns, image)

    def close(self) -> None:
        self._proxy.end()


class Listening:
    """Reports each feedback and frame once, on the connection's receiving thread.

    Args:
        received: Called with each.
    """

    def __init__(self, received: Received) -> None:
        self._received = received
        self._known_ns = 0

    def feedback(self, feedback: Feedback) -> None:
        """Report feedback that is new."""
        if feedback.captured_ns > self._known_ns:  # the proxy repeats an old state when somebody took the authority
            self._known_ns = feedback.captured_ns
            self._received(FEEDBACK, feedback.captured_ns)

    def frame(self, frame: Frame) -> None:
        """Report a frame."""
        self._received(VIDEO, frame.captured_ns)

    def picture(self, picture: EncodedFrame) -> None:
        """Report an encoded picture."""
        self._received(VIDEO, picture.captured_ns)


class Application:
    """The application's end; see :class:`skyloop.bench.contract.ApplicationEnd`."""

    looks = True  #: at the video
    video = VideoOptions()  #: how it wants that

    def __init__(self, address: str, received: Received) -> None:
        self._drone = self._connect(address)
        listening = Listening(received)
        self._drone.on_feedback(listening.feedback, inline=True)
        if self.looks:
            self._drone.on_frame(listening.frame, camera=CAMERA, inline=True, **self.video)

    def _connect(self, address: str) -> Drone:
        return connect(proxy_name(address), name="bench", on_exit="hover")

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        forward, left, yaw_rate = setpoint
        self._drone.velocity(forward=forward, left=left, up=stamped(sent_ns), yaw_rate=yaw_rate)

    def close(self) -> None:
        self._drone.close()
