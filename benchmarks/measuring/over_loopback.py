"""Skyloop's own ends over the network transport, on the loopback interface; frames are raw, as for all contenders."""

from __future__ import annotations

from pathlib import Path

from benchmarks.measuring.contract import Received
from benchmarks.measuring.ours import Application as NearApplication
from benchmarks.measuring.ours import Listening, proxy_name
from benchmarks.measuring.ours import Vehicle as NearVehicle
from skyloop.bench import CAMERA, BenchVehicle
from skyloop.client import connect
from skyloop.network import FabricServer, FabricSettings
from skyloop.network.config import free_port
from skyloop.proxy import Proxy

_HOST = "127.0.0.1"


class Vehicle(NearVehicle):
    """The vehicle's end, which listens on a free port of loopback."""

    def __init__(self, address: str, received: Received) -> None:
        name, place = proxy_name(address), f"{_HOST}:{free_port(_HOST)}"
        self._vehicle = BenchVehicle(received)
        server = FabricServer(name, FabricSettings(listen=(place,), multicast=False))
        self._proxy = Proxy(self._vehicle, server, name=name)
        self._proxy.start()
        (Path(address) / "fabric").write_text(place)


class Application(NearApplication):
    """The application's end, which connects to that port."""

    def __init__(self, address: str, received: Received) -> None:
        place = (Path(address) / "fabric").read_text()
        self._drone = connect(proxy_name(address), name="bench", on_exit="hover", network=place)
        listening = Listening(received)
        self._drone.on_feedback(listening.feedback, inline=True)
        self._drone.on_frame(listening.frame, camera=CAMERA, inline=True, encoding="raw")
