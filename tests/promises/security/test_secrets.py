"""Passwords and keys in an address never leave the vehicle's driver by any path."""

from __future__ import annotations

import copy
import json
import os
import pickle
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest

import skyloop
from skyloop.address import shown_address
from skyloop.cockpit.access import Person, Token
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.live_camera import source_of
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.errors import DriverError, SkyloopError
from skyloop.host.fleet import encode_handed, parse_fleet
from skyloop.host.host import Host
from skyloop.host.own_process import OwnProcessVehicle
from skyloop.host.serve import Add, StatusRequest
from skyloop.messages import Capabilities, EventKind, GetParameter, LinkState, Role, Severity
from skyloop.network.packets import Key
from skyloop.proxy import Proxy
from skyloop.proxy.records import AuditTrail
from skyloop.transport.memory import MemoryServer
from skyloop.vehicles.mavlink.options import options_of as mavlink_options
from skyloop.vehicles.replay.driver import options_of as replay_options
from skyloop.vehicles.sim.options import firmware_options
from skyloop.vehicles.video.driver import options_of as video_options
from tests.support.proxy_bench import App, Bench

SECRET = "s3cr3t"
CAMERA = f"rtsp://admin:{SECRET}@127.0.0.1:9/live"


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("sim://?seed=1", "sim://?seed=1"),
        ("video:///home/me/a@b.mp4?fps=30", "video:///home/me/a@b.mp4?fps=30"),
        ("ardrone://192.168.1.1", "ardrone://192.168.1.1"),
        ("mavlink://udpin:[::]:14550", "mavlink://udpin:[::]:14550"),
        ("video://rtsp://[fe80::1]:554/live", "video://rtsp://[fe80::1]:554/live"),
        ("mavlink://serial:/dev/serial/by-id/usb-x@1:57600?rate=5",) * 2,
        ("mavlink://serial:/dev/serial/by-id/usb-x%401:57600",) * 2,
        (f"mavlink://tcp:admin:{SECRET}@10.0.0.1:5760", "mavlink://10.0.0.1:5760"),
        (f"mavlink://serial:{SECRET}@10.0.0.1:5760", "mavlink://10.0.0.1:5760"),
        (f"tello://serial:/{SECRET}@10.0.0.1", "tello://10.0.0.1"),
        (f"video://rtsp://admin:{SECRET}@cam:554/live?fps=10", "video://rtsp://cam:554/live?fps=10"),
        (f"video://rtsp://admin:p@{SECRET}@cam/live", "video://rtsp://cam/live"),
        (f"video://rtsp://admin:pa/{SECRET}@cam/live", "video://rtsp://cam/live"),
        (f"video://rtsp://admin:pa%2F{SECRET}@cam/live", "video://rtsp://cam/live"),
        (f"video://rtsp://{SECRET}@cam/live", "video://rtsp://cam/live"),
        (f"video://rtsp://cam/live%3Ftoken={SECRET}", "video://rtsp://cam/live"),
        (f"video://http://cam/user=a&password={SECRET}/1", "video://http://cam/user=a&password=***/1"),
        (f"video://rtsp://cam/user=a_password={SECRET}_x.sdp", "video://rtsp://cam/user=a_password=***"),
        # A password with an unencoded character that separates an address's parts: its end is ambiguous.
        (f"video://rtsp://admin:{SECRET}?x@cam/live", "video://rtsp://***?***"),
        (f"video://rtsp://admin:123?{SECRET}@cam/live", "video://rtsp://***?***"),
        (f"mavlink://udp:?camera=rtsp://u:{SECRET}&x@cam/live", "mavlink://udp:?camera=rtsp://***&***"),
        (
            f"mavlink://udp:?camera=rtsp://u:a%26{SECRET}@cam/live&rate=5",
            "mavlink://udp:?camera=rtsp://cam/live&rate=5",
        ),
        (f"mavlink://udp:?signing_key={SECRET}", "mavlink://udp:?signing_key=***"),
        (f"thing://user:{SECRET}@robot?api_token={SECRET}&speed=2", "thing://robot?api_token=***&speed=2"),
        (f"admin:{SECRET}@cam/live", "cam/live"),
    ],
)
def test_an_address_is_shown_without_its_secrets(given: str, shown: str) -> None:
    assert shown_address(given) == shown
    if "://" in given:
        uri = parse_uri(given)
        texts = [str(uri), repr(uri), f"{uri}", uri.place, json.dumps(dict(uri.options)), repr(uri.options)]
        texts += [repr(VehicleUri(uri.scheme, uri.reveal_place(), {o: uri.reveal(o) or "" for o in uri.options}))]
        texts += [repr(pickle.dumps(uri)), repr(pickle.loads(pickle.dumps(uri)))]
        assert SECRET not in "".join(texts)
        assert str(uri) == shown
        assert copy.deepcopy(uri) == copy.copy(uri) == uri == parse_uri(given)
        assert uri.reveal_text() == given
        with pytest.raises(TypeError):
            msgspec.json.encode(uri)


def test_only_the_code_that_opens_the_vehicle_gets_the_secret(tmp_path: Path) -> None:
    video = video_options(parse_uri(f"video://{CAMERA}"))
    assert video.source is not None
    assert video.source.name == CAMERA
    key = tmp_path / "key"
    key.write_text("00" * 32)
    flown = mavlink_options(parse_uri(f"mavlink://udpin:0.0.0.0:1?camera={CAMERA}&signing_key={key}"))
    assert flown.camera is not None
    assert (flown.camera.source, flown.key) == (CAMERA, bytes(32))
    assert "camera=" in firmware_options(parse_uri(f"sim://?autopilot=px4&camera={CAMERA}"))
    assert SECRET not in f"{video!r} {flown!r}"
    assert "x00" not in repr(flown)


@pytest.mark.parametrize(
    "address",
    [
        f"video://ftp://admin:{SECRET}@cam/live",
        f"video://rtsp://admin:{SECRET}@:0/live",
        f"video://rtp://admin:{SECRET}@somewhere:5600",
        f"video://{CAMERA}?loop=1",
        f"video://{CAMERA}?no_such=1",
        f"video://{CAMERA}?fps=fast",
        f"video://{CAMERA}?fps=1&fps=2",
        f"video://rtsp://admin:x?{SECRET}@cam/live",
        f"mavlink://udpin:0.0.0.0:1?signing_key={SECRET}",
        f"mavlink://udpin:0.0.0.0:1?camera=ftp://u:{SECRET}@cam",
        f"no-such://admin:{SECRET}@cam",
        f"admin:{SECRET}@cam",
    ],
)
def test_errors_about_an_address_do_not_repeat_its_secrets(address: str) -> None:
    from skyloop.drivers.registry import make_driver

    with pytest.raises(SkyloopError) as wrong:
        make_driver(address)
    assert SECRET not in f"{wrong.value} {wrong.value!r}"


def test_the_error_about_a_camera_does_not_repeat_its_secrets() -> None:
    with pytest.raises(SkyloopError) as wrong:
        source_of(f"ftp://admin:{SECRET}@cam", "camera")
    assert SECRET not in str(wrong.value)


class Careless(Driver):
    """A driver that repeats its library's messages, including the address."""

    def __init__(self, *, opens: bool = True) -> None:
        super().__init__(parse_uri(f"video://{CAMERA}?camera=front"))
        self._opens = opens
        self.sink: Sink | None = None

    def capabilities(self) -> Capabilities:
        return Capabilities("careless", frozenset(), (), why_not=f"{self.uri} is a camera")

    def _open(self, sink: Sink) -> None:
        if not self._opens:
            raise OSError(111, "Connection refused", self.uri.reveal_place())
        self.sink = sink
        sink.link(LinkState.LOST, f"can't open {CAMERA}", f"check {SECRET}")
        sink.event(EventKind.VEHICLE_MESSAGE, f"tried {self.uri.reveal_text()}", Severity.WARNING, where=CAMERA)

    def _close(self) -> None: ...

    def set_parameter(self, name: str, value: object) -> object:  # type: ignore[override]
        raise ConnectionError(CAMERA)


def test_a_librarys_messages_about_the_address_are_shown_without_the_secrets(tmp_path: Path) -> None:
    """Events, the link's reason, answers, feedback, the overview, Welcome and the audit trail, byte by byte."""
    server, audit = MemoryServer("careless"), tmp_path / "audit.jsonl"
    driver = Careless()
    proxy = Proxy(driver, server, name="careless", ticker=False)
    sent: list[bytes] = []
    proxy.events._publish = lambda _, packet: sent.append(packet) or 0  # type: ignore[func-returns-value]
    proxy.keep_trail(AuditTrail(audit, "careless", "r1"))
    proxy.start()
    app = App(server.dial, proxy.clock)
    welcome = app.hello("watcher")
    proxy.publisher.driver_failed("apply", ConnectionError(CAMERA))
    answers = [proxy.publisher.driver_refused("apply", error(CAMERA)) for error in (DriverError, ConnectionError)]
    told = f"{welcome!r} {app.ask(GetParameter('x'))!r} {answers} {proxy.overview._row()!r} {sent}"
    told += f"{proxy.publisher.link_reason} {proxy.publisher.link_remedy}"
    proxy.end()
    app.end.close()
    assert "can't open" in told
    assert "rtsp://127.0.0.1:9/live" in told
    assert SECRET not in told
    assert SECRET not in audit.read_text()
    assert "rtsp://127.0.0.1:9/live" in audit.read_text()


def test_a_driver_that_fails_to_open_is_quoted_without_the_secrets() -> None:
    proxy = Proxy(Careless(opens=False), MemoryServer("closed"), name="closed", ticker=False)
    with pytest.raises(DriverError, match="Connection refused") as failed:
        proxy.start()
    assert SECRET not in str(failed.value)
    assert failed.value.__suppress_context__


def test_keys_and_tokens_do_not_show_themselves() -> None:
    token = Token(Person(Role.PILOT, "ann"), SECRET.encode())
    assert SECRET not in f"{token!r} {Key(3, SECRET.encode())!r}"


@pytest.mark.parametrize("path", ["/data/key=7/flight.mcap", "C:/Users/me@home/flight.mcap"])
def test_a_recording_is_found_in_a_folder_that_looks_like_a_secret(path: str) -> None:
    assert str(replay_options(parse_uri(f"replay://{path}")).path) == path


def test_a_short_secret_hides_nothing_but_itself() -> None:
    """Each of its letters was hidden in all texts about the vehicle, and could be read from that."""
    uri = parse_uri("mavlink://udp:0.0.0.0:14550?signing_key=ab&camera=rtsp://u:p@h/x")
    assert uri.scrub("up, not able to open rtsp://u:p@h/x") == "up, not able to open rtsp://h/x"
    assert uri.scrub("key ab, password p") == "key ***, password ***"


def test_without_secrets_nothing_is_changed() -> None:
    with Bench() as bench:
        assert bench.driver.uri.scrub("fake:// failed at fake://x") == "fake:// failed at fake://x"


FLEET = f'[[vehicle]]\nname = "cam"\naddress = "video://{CAMERA}"\n'


def test_a_host_shows_addresses_without_secrets_and_serves_with_them() -> None:
    (settings,) = parse_fleet(FLEET, "fleet.toml").vehicles
    assert settings.address.reveal_place() == CAMERA
    assert SECRET in encode_handed(Add((settings,))).decode()  # for the host's own socket, and its children
    with pytest.raises(TypeError):
        msgspec.json.encode(settings)
    with pytest.raises(TypeError):
        encode_handed(object())
    host = Host(print)
    host.known["cam"] = settings
    rows = [OwnProcessVehicle(settings, print).row(), *host.status()]
    host.close()
    assert [row.address for row in rows] == ["video://rtsp://127.0.0.1:9/live"] * 2
    assert SECRET not in f"{settings!r} {rows!r} {Add((settings,))!r} {StatusRequest()!r}"


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux", reason="reads command lines from /proc")
@pytest.mark.usefixtures("sockets")
def test_a_camera_with_a_password_is_flown_without_showing_it_to_anyone(tmp_path: Path) -> None:
    """Real processes: ``ps``, ``skyloop list``, ``drone.uri``, events, a recording and its export."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        camera = f"rtsp://admin:{SECRET}@127.0.0.1:{silent.getsockname()[1]}/live"
        with skyloop.connect(f"video://{camera}") as drone:
            listed = _skyloop("list", "--json")
            lines = [line for one in Path("/proc").glob("[0-9]*/cmdline") if b"skyloop" in (line := _read(one))]
            path = tmp_path / "flight.mcap"
            with skyloop.record(drone, path, min_free_mb=0):
                pass
            told = f"{drone.uri} {drone!r} {drone.capabilities!r} {drone.feedback()!r}"
    assert any(b"video://rtsp://127.0.0.1" in line for line in lines)
    held = b"".join([told.encode(), listed, path.read_bytes(), _skyloop("log", "info", str(path)), *lines])
    assert b"127.0.0.1" in listed
    assert SECRET.encode() not in held
    assert "SKYLOOP_HANDED_OVER" not in os.environ


def _read(path: Path) -> bytes:
    with suppress(OSError):  # it may have ended meanwhile
        return path.read_bytes()
    return b""


def _skyloop(*words: str) -> bytes:
    return subprocess.run([sys.executable, "-m", "skyloop", *words], capture_output=True, check=True).stdout
