"""The recorded video of real drones through the whole driver, together with mostly recorded navdata."""

from __future__ import annotations

import functools
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest

from skyloop.drivers.live_video import VideoCounters
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.messages import LinkState
from skyloop.vehicles.ardrone.driver import ArdroneDriver
from skyloop.vehicles.ardrone.wire.navdata import Demo, Navdata, Time, decode
from tests.support.recordings import recorded
from tests.vehicles.ardrone.scripted import ScriptedDrone
from tests.vehicles.ardrone.video_ports import HOST, LONG, SHORT, TcpPort, digest, frames, pieces, true_pictures


@functools.cache
def navdata() -> Navdata:
    return decode(recorded("ardrone2/navdata-full-landed.bin").read_bytes())


PATIENCE_S = 10.0
NAVDATA_S = 0.01


class Radio:
    """A scripted drone behind sockets: navdata and AT over UDP, its configuration over TCP. With a thread."""

    def __init__(self, drone: ScriptedDrone) -> None:
        self._drone = drone
        self._navdata, self._at = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for one in (self._navdata, self._at):
            one.bind((HOST, 0))
        self._control = socket.create_server((HOST, 0))
        self._asked: socket.socket | None = None  # the connection to the control port
        self._listener: tuple[str, int] | None = None  # of navdata
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def options(self) -> str:
        """Query of an address for a driver to reach it."""
        ports = {"navdata_port": self._navdata, "at_port": self._at, "control_port": self._control}
        return "&".join(f"{name}={one.getsockname()[1]}" for name, one in ports.items())

    def __enter__(self) -> Radio:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(PATIENCE_S)
        for one in (self._navdata, self._at, self._control, self._asked):
            if one is not None:
                one.close()
        assert not self._thread.is_alive()

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            for one in (self._navdata, self._at, self._control):
                selector.register(one, selectors.EVENT_READ)
            due_s = time.monotonic()
            while not self._ended.is_set():
                for key, _ in selector.select(max(0.0, due_s - time.monotonic())):
                    self._serve(key.fileobj)
                if time.monotonic() >= due_s:
                    due_s += NAVDATA_S
                    self._tell()

    def _serve(self, ready: object) -> None:
        if ready is self._navdata:
            self._listener = self._navdata.recvfrom(64)[1]
        elif ready is self._at:
            self._drone.take(self._at.recv(4096))
        else:
            if self._asked is not None:
                self._asked.close()
            self._asked = self._control.accept()[0]

    def _tell(self) -> None:
        if self._drone.dump_asked and self._asked is not None:
            self._drone.dump_asked = False
            self._asked.sendall(self._drone.dump())
        if self._listener is not None:
            with suppress(OSError):  # it has left
                self._navdata.sendto(self._drone.navdata(), self._listener)


def counters(driver: ArdroneDriver) -> VideoCounters:
    """Return the counters directly: those in the telemetry arrive with the next feedback."""
    return VideoCounters() if driver._video is None else driver._video.counters


def in_step(name: str, driver: list[ArdroneDriver], sink: RecordingSink) -> Callable[[socket.socket], None]:
    """Send a recording frame by frame, each once all earlier ones were processed, so that none is late."""

    def dealt_with(number: int) -> bool:
        known = counters(driver[0])
        return known.frames + known.waited + known.damaged + known.skipped >= number

    def play(connection: socket.socket) -> None:
        for number, piece in enumerate(pieces(name)):
            if number > 1:  # the first one is held back until the second arrives
                assert sink.wait(lambda number=number: dealt_with(number), PATIENCE_S)  # type: ignore[misc]
            connection.sendall(piece)
        connection.recv(1)

    return play


@contextmanager
def flown(name: str) -> Iterator[tuple[ArdroneDriver, RecordingSink]]:
    """Return a driver whose drone sends this recording."""
    drone = ScriptedDrone()
    drone.telemetry = [option for kind, option in navdata().options.items() if kind not in (Demo, Time)]
    sink = RecordingSink()
    opened: list[ArdroneDriver] = []
    with Radio(drone) as radio, TcpPort(in_step(name, opened, sink)) as port:
        driver = make_driver(f"ardrone://{HOST}?{radio.options}&video_port={port.port}&navdata=full")
        assert isinstance(driver, ArdroneDriver)
        opened.append(driver)
        driver.open(sink)
        try:
            yield driver, sink
        finally:
            driver.close()
    assert not sink.problems, sink.problems


@pytest.mark.parametrize(("name", "pictures", "waited", "damaged"), [(LONG, 240, 0, 0), (SHORT, 17, 2, 1)])
def test_a_recording_from_the_drones_socket_to_the_sink(name: str, pictures: int, waited: int, damaged: int) -> None:
    def told(driver: ArdroneDriver, sink: RecordingSink) -> bool:
        known = counters(driver)
        return known.frames + known.skipped == pictures == sink.frame_counts["front"] + known.skipped

    with flown(name) as (driver, sink):
        assert sink.wait(lambda: told(driver, sink), PATIENCE_S), (counters(driver), sink.links, list(sink.events))
        ended = counters(driver)
        assert sink.wait(lambda: _native(sink).get("video.frames") == ended.frames, PATIENCE_S)
        native = _native(sink)
        assert sink.link_state is LinkState.UP
        assert driver.capabilities().cameras[0].name == "front"
    assert set(sink.frame_counts) == {"front"}
    assert ended.skipped <= 1, "at most the first of the two that arrive together"
    assert (ended.waited, ended.damaged, ended.refused, ended.reconnects) == (waited, damaged, 0, 0)
    assert {(frame.width, frame.height) for frame in sink.frames} == {(640, 360)}
    true = [content for _, content in sorted(true_pictures(name).items())]
    assert len(true) == pictures, "none before the first key frame"
    seen = [digest(frame.pixels.tobytes()) for frame in sink.frames]  # the newest 64, or all
    assert seen == true[-len(seen) :]
    assert len(frames(name)) == pictures + waited + damaged
    # The telemetry beside it: values from the drone's recording, except the scripted ones.
    assert native["video.received"] == len(frames(name)) - damaged
    assert native["navdata.damaged"] == native["navdata.unknown"] == 0
    assert "magneto.heading" in native
    assert sink.newest is not None
    assert sink.newest.battery == pytest.approx(0.7)


def _native(sink: RecordingSink) -> dict[str, object]:
    return dict((sink.newest.native or {}) if sink.newest is not None else {})
