"""The AI-deck's images from a connection to frames: times, stalls, faults, colours, and the vehicle's state."""

from __future__ import annotations

import re
import socket
import sys
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from skyloop.calibration import Calibration
from skyloop.clock import ManualClock, monotonic_ns
from skyloop.drivers import live_video
from skyloop.drivers.live_video import Coded
from skyloop.drivers.uri import parse_uri
from skyloop.errors import MissingExtraError, UnsupportedError, UsageError
from skyloop.messages import Encoding, EventKind, Severity
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.crazyflie import deck as module
from skyloop.vehicles.crazyflie.deck import (
    DECK_OPTIONS,
    FUTILE,
    PICTURELESS_S,
    SILENT_S,
    SIZES,
    DeckDecoder,
    DeckStamps,
    DeckStream,
    deck_options,
)
from skyloop.vehicles.crazyflie.emulator.deck import DeckFaults, DeckPacker, to_grey
from skyloop.vehicles.crazyflie.wire.cpx import Counting, Packet, PacketParser, encode, restart_camera
from skyloop.vehicles.crazyflie.wire.pictures import Format, Picture, PictureAssembly, newer_packets, older_packets
from tests.support.pages import rows, section
from tests.vehicles.crazyflie.deck_rig import (
    WITHIN_S,
    Pixels,
    ScriptedDeck,
    ShownDeck,
    SimulatedDeck,
    number_of,
    options,
    receiving,
    scene,
    until_closed,
)

MS = 1_000_000


def on_wire(packets: list[Packet], counting: Counting = Counting.ROUTE_AND_DATA) -> bytes:
    return b"".join(encode(packet, counting) for packet in packets)


def older(number: int = 1) -> bytes:
    return on_wire(DeckPacker("grey", 0).packets(scene(number), 0))


# Options -------------------------------------------------------------------------------------------------------------


def test_an_address_without_a_deck_has_none() -> None:
    assert deck_options(parse_uri("crazyflie://udp")) is None


def test_a_deck_has_its_port_unless_another_is_given() -> None:
    short = deck_options(parse_uri("crazyflie://udp?deck=192.168.4.1"))
    long = deck_options(parse_uri("crazyflie://udp?deck=aideck.local:5001&deck_size=162x162&deck_colour=1"))
    assert short is not None
    assert long is not None
    assert (short.host, short.port, short.camera.width, short.camera.height) == ("192.168.4.1", 5000, 324, 244)
    assert (long.host, long.port, long.camera.width, long.camera.fps) == ("aideck.local", 5001, 162, 60.0)
    assert (short.camera.encoding, long.camera.encoding) == (Encoding.MONO8, Encoding.BGR8)


@pytest.mark.parametrize(
    "text",
    [
        "deck=",
        "deck=a b",
        "deck=host:0",
        "deck=host:70000",
        "deck=host&deck_size=640x480",
        "deck=host&deck_colour=maybe",
        "deck=host&cx=3",
        "deck_size=162x162",
        "fx=180",
    ],
)
def test_invalid_options_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        deck_options(parse_uri(f"crazyflie://udp?{text}"))


def test_a_calibration_applies_to_images_of_its_shape(tmp_path: Path) -> None:
    file = tmp_path / "deck.json"
    Calibration(width=324, height=244, model="pinhole", fx=180.0, fy=181.0, cx=161.0, cy=121.0).save(file)
    grey = deck_options(parse_uri(f"crazyflie://udp?deck=host&calibration={file}"))
    small = deck_options(parse_uri(f"crazyflie://udp?deck=host&calibration={file}&deck_size=162x162"))
    assert grey is not None
    assert small is not None
    assert grey.camera.intrinsics is not None
    assert grey.camera.intrinsics.fy == 181.0
    assert small.camera.intrinsics is None


# One connection ------------------------------------------------------------------------------------------------------


@pytest.fixture
def wire() -> Iterator[tuple[socket.socket, DeckStream, ManualClock]]:
    deck, host = socket.socketpair()
    clock = ManualClock()
    stream = DeckStream(host, 0, clock)
    yield deck, stream, clock
    deck.close()
    stream.close()


Wire = tuple[socket.socket, DeckStream, ManualClock]


def all_of(stream: DeckStream, count: int) -> list[Coded]:
    frames: list[Coded] = []
    while len(frames) < count:
        frames += stream.read()
    return frames


def test_an_image_is_captured_when_its_announcement_arrives(wire: Wire) -> None:
    deck, stream, clock = wire
    data = older()
    deck.sendall(data[:40_000])
    begun_ns = clock()
    while True:
        assert stream.read() == []
        if len(stream._assembly._data or b"") > 39_000:
            break
    clock.advance(0.05)
    sender = threading.Thread(target=deck.sendall, args=(data[40_000:],))
    sender.start()
    (coded,) = all_of(stream, 1)
    sender.join()
    assert (coded.captured_ns, coded.arrived_ns) == (begun_ns, begun_ns + 50 * MS)
    assert coded.is_key


def test_stamps_keep_the_times_between_images_whatever_the_wifi_does() -> None:
    stamps, late_ms = DeckStamps(), (9, 4, 30, 3, 12, 3)
    start_us = (1 << 32) - 40_000  # the deck's clock wraps around on the way
    times = [
        stamps.captured_ns((start_us + n * 16_667) % (1 << 32), n * 16_667_000 + late * MS)
        for n, late in enumerate(late_ms)
    ]
    assert all(later >= earlier for earlier, later in pairwise(times))
    assert times[-1] == 5 * 16_667_000 + 3 * MS
    assert times[4] == 4 * 16_667_000 + 3 * MS


def test_a_silent_connection_has_stalled(wire: Wire) -> None:
    deck, stream, clock = wire
    deck.sendall(older())
    all_of(stream, 1)
    clock.advance(SILENT_S)
    assert stream.read() == []
    clock.advance(0.01)
    with pytest.raises(TimeoutError, match=r"nothing for 1\.5 s"):
        stream.read()


def test_a_connection_that_completes_no_image_has_stalled(wire: Wire) -> None:
    deck, stream, clock = wire
    data = older()
    for n in range(round(PICTURELESS_S) + 1):
        deck.sendall(data[n : n + 1])
        assert stream.read() == []
        clock.advance(1.0)
    deck.sendall(data[n + 1 : n + 2])
    with pytest.raises(TimeoutError, match="no whole image"):
        stream.read()


def test_a_closed_connection_and_a_senseless_one_are_lost(wire: Wire) -> None:
    deck, stream, _ = wire
    deck.sendall(b"\xff\xff\xff\xff")
    with pytest.raises(ConnectionError, match="CPX"):
        stream.read()
    deck.shutdown(socket.SHUT_WR)
    with pytest.raises(ConnectionError, match="closed"):
        stream.read()


def test_closing_with_unread_images_ends_the_connection_in_order() -> None:
    ended: list[bytes] = []

    def send_much(connection: socket.socket) -> None:
        connection.sendall(older() * 3)
        ended.append(until_closed(connection))  # raises ConnectionResetError otherwise

    with ScriptedDeck(send_much) as deck:
        stream = DeckStream(socket.create_connection(("127.0.0.1", deck.port)), 0, monotonic_ns)
        all_of(stream, 1)
        stream.close()
    assert ended == [b""]


# Images --------------------------------------------------------------------------------------------------------------


def decoded(picture: Picture, *, colour: bool = False) -> Pixels | None:
    got = DeckDecoder(colour=colour).decode(Coded(picture, True, 0, 0, 0), show=True)
    return None if got is None else got.pixels


def test_colour_comes_back_from_a_mosaic() -> None:
    pytest.importorskip("cv2")
    shown = np.zeros((244, 324, 3), np.uint8)
    shown[:, :108], shown[:, 108:216], shown[:, 216:] = (200, 30, 10), (20, 180, 40), (15, 25, 220)
    parser = PacketParser()
    assembly = PictureAssembly()
    got = [assembly.feed(packet) for packet in parser.feed(on_wire(DeckPacker("bayer", 0).packets(shown, 0)))]
    picture = got[-1]
    assert picture is not None
    pixels = decoded(picture, colour=True)
    assert pixels is not None
    assert pixels.shape == (244, 324, 3)
    for columns in (slice(4, 104), slice(112, 212), slice(220, 320)):
        assert np.array_equal(pixels[4:-4, columns], shown[4:-4, columns])


def test_a_jpeg_of_another_size_or_damaged_is_not_shown() -> None:
    cv2 = pytest.importorskip("cv2")
    data = cv2.imencode(".jpg", to_grey(scene(1)))[1].tobytes()
    assert decoded(Picture(324, 244, Format.JPEG, data, 1)) is not None
    decoder = DeckDecoder()
    for wrong in (Picture(324, 240, Format.JPEG, data, 1), Picture(324, 244, Format.JPEG, data[:80], 2)):
        assert decoder.decode(Coded(wrong, True, 0, 0, 0), show=True) is None
    assert decoder.damaged == 2


def test_without_opencv_jpegs_and_colour_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(UnsupportedError, match="vision"):
        decoded(Picture(324, 244, Format.JPEG, b"\xff\xd8", 1))
    with pytest.raises(MissingExtraError), receiving(options(9, "&deck_colour=1")):
        pass


@pytest.mark.parametrize("picture", [Picture(4, 4, 9, bytes(16), 1), Picture(0, 0, 0, b"", 1, version=11)])
def test_unknown_formats_and_versions_are_refused(picture: Picture) -> None:
    with pytest.raises(UnsupportedError):
        decoded(picture)


def test_numbers_of_eight_bits_go_on_counting() -> None:
    decoder = DeckDecoder()
    numbers = [0xFE, 0xFF, 0x00, 0x03]
    pictures = [Picture(2, 1, Format.RAW, b"ab", number) for number in numbers]
    got = [decoder.decode(Coded(picture, True, 0, 0, 0), show=True) for picture in pictures]
    assert [one.number for one in got if one is not None] == [254, 255, 256, 259]


# The emulated deck ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stream", ["grey", "bayer", "jpeg", "state"])
def test_the_emulated_decks_images_arrive(stream: str) -> None:
    if stream == "jpeg":
        pytest.importorskip("cv2")
    with ShownDeck(stream) as shown, receiving(options(shown.deck.port)) as (video, sink):
        assert sink.wait(lambda: sink.frame_counts["front"] >= 5, WITHIN_S)
        telemetry = video.telemetry()
        frame = sink.frames[-1]
    small = stream == "state"
    assert sink.problems == []
    assert (frame.width, frame.height) == ((162, 162) if small else (324, 244))
    assert frame.encoding is Encoding.MONO8
    if stream in ("grey", "state"):
        assert all(number_of(seen.pixels) for seen in sink.frames)
        assert len({number_of(seen.pixels) for seen in sink.frames}) == len(sink.frames)
    assert telemetry["deck.stalls"] == 0
    if small:
        x = telemetry["deck.position_m.x"]
        age = telemetry["deck.state_age_s"]
        assert isinstance(x, float)
        assert isinstance(age, float)
        assert 0.0 < x <= shown.shown / 1000.0
        assert 0.0 <= age < 2.0
        assert "deck.velocity_m_s.x" not in telemetry
    else:
        assert "deck.position_m.x" not in telemetry


def test_images_come_from_the_simulated_camera() -> None:
    with (
        SimulatedDeck(SimHost(SimOptions(world="room", seed=1)), "state") as simulated,
        receiving(options(simulated.deck.port)) as (video, sink),
    ):
        assert sink.wait(lambda: sink.frame_counts["front"] >= 10, WITHIN_S)
        state = video.state
    assert sink.problems == []
    assert sink.frames[-1].pixels.std() > 5.0
    assert state is not None
    assert state[0].velocity_m_s == pytest.approx((0.0, 0.0, 0.0), abs=0.01)


def test_without_a_subscriber_nothing_is_decoded() -> None:
    with ShownDeck() as shown, receiving(options(shown.deck.port)) as (video, sink):
        sink.watch = set()
        assert sink.wait(lambda: bool(sink.events), WITHIN_S)
        before = sink.frame_counts["front"]
        sink.watch = None
        assert sink.wait(lambda: sink.frame_counts["front"] > before, WITHIN_S)
        assert video.telemetry()["deck.received"]


# Stalls --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the pauses before connecting again."""
    monkeypatch.setattr(live_video, "RETRY_S", (0.01, 0.02, 0.04))


@pytest.fixture
def impatient(eager: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten all waiting, so that a stall costs a fraction of a second."""
    monkeypatch.setattr(module, "SILENT_S", 0.25)
    monkeypatch.setattr(module, "PICTURELESS_S", 0.6)


@pytest.mark.usefixtures("impatient")
def test_a_stall_is_reported_and_mended_by_reconnecting() -> None:
    def freeze(connection: socket.socket) -> None:
        connection.sendall(older(1))
        assert until_closed(connection) == b""

    def go_on(connection: socket.socket) -> None:
        connection.sendall(older(2))
        until_closed(connection)

    with ScriptedDeck(freeze, go_on) as deck, receiving(options(deck.port)) as (video, sink):
        assert sink.wait(lambda: sink.frame_counts["front"] >= 2, WITHIN_S)
        reasons = [event.data.get("reason") for event in sink.events]
        lost = next(event for event in sink.events if event.data.get("reason") == "deck_lost")
        assert video.telemetry()["deck.reconnects"] == 1
    assert reasons == [None, "deck_lost", None]
    assert (lost.kind, lost.severity) == (EventKind.VEHICLE_MESSAGE, Severity.WARNING)
    assert "nothing for" in lost.text
    assert "deck_restart=1" in lost.text


@pytest.mark.usefixtures("impatient")
def test_a_deck_that_stays_silent_is_reported_once_and_asked_again_and_again() -> None:
    with ScriptedDeck(until_closed) as deck, receiving(options(deck.port)) as (_, sink):  # type: ignore[arg-type]
        assert sink.wait(lambda: bool(sink.events), WITHIN_S)
        tried = threading.Event()
        for _ in range(1000):
            if deck.connections >= 4 or tried.wait(0.01):
                break
        assert deck.connections >= 4
        assert [event.data.get("reason") for event in sink.events] == ["deck_lost"]


@pytest.mark.usefixtures("eager")
def test_a_deck_that_is_switched_on_later_is_found() -> None:
    with socket.create_server(("127.0.0.1", 0)) as reserved:
        port = reserved.getsockname()[1]
    with receiving(options(port)) as (video, sink):
        assert sink.wait(lambda: bool(sink.events), WITHIN_S)
        with ShownDeck(port=port):
            assert sink.wait(lambda: sink.frame_counts["front"] > 0, WITHIN_S)
            assert video.telemetry()["deck.stalls"] == 0
    assert [event.data.get("reason") for event in sink.events][:2] == ["deck_unreachable", None]
    assert "deck_restart" not in sink.events[0].text


@pytest.mark.usefixtures("impatient")
def test_a_hung_camera_comes_back_by_a_restart_if_the_user_allows_it() -> None:
    with ShownDeck(faults=DeckFaults(seed=3, hang=0.1)) as shown:
        with receiving(options(shown.deck.port, "&deck_restart=1")) as (video, sink):
            assert sink.wait(lambda: shown.deck.restarts >= 1 and sink.frame_counts["front"] >= 1, WITHIN_S)
            before, restarts = sink.frame_counts["front"], shown.deck.restarts
            assert sink.wait(lambda: sink.frame_counts["front"] > before + 10 * restarts, WITHIN_S)
            assert video.telemetry()["deck.restarts"]
        assert any(event.data.get("reason") == "deck_restarted" for event in sink.events)


@pytest.mark.usefixtures("impatient")
def test_nothing_is_restarted_unless_the_user_allows_it() -> None:
    with ShownDeck(faults=DeckFaults(hang=1.0)) as shown, receiving(options(shown.deck.port)) as (_, sink):
        assert sink.wait(lambda: bool(sink.events), WITHIN_S)
        waiting = threading.Event()
        while shown.deck.clients < 6:
            waiting.wait(0.01)
    assert shown.deck.restarts == 0


def test_a_restart_asks_the_wifi_chip_and_reconnects(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FUTILE", 0)
    monkeypatch.setattr(live_video, "RETRY_S", (0.01,))
    asked: list[bytes] = []
    with (
        ScriptedDeck(lambda connection: asked.append(until_closed(connection))) as deck,
        receiving(options(deck.port, "&deck_restart=1")) as (_, sink),
    ):
        assert sink.wait(lambda: len(sink.events) >= 2, WITHIN_S)
    assert asked[0] == b"".join(encode(packet) for packet in restart_camera())


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("stream", ["grey", "state"])
def test_whatever_goes_wrong_only_whole_images_are_shown_and_they_come_back(stream: str, seed: int) -> None:
    faults = DeckFaults(seed=seed, stall=0.03, cut=0.1, close=0.05, wrong_length=0.05)
    with ShownDeck(stream, faults) as shown, receiving(options(shown.deck.port)) as (video, sink):
        assert sink.wait(lambda: sink.frame_counts["front"] >= 60, 60.0)
        counters = video.telemetry()
        frames = list(sink.frames)
    assert sink.problems == []
    camera = shown.deck.camera
    numbers = [number_of(seen.pixels) for seen in frames]
    assert all(earlier < later for earlier, later in pairwise(numbers))
    for number, seen in zip(numbers, frames, strict=True):
        assert np.array_equal(seen.pixels, to_grey(scene(number, camera.width, camera.height)))
    assert counters["deck.reconnects"]
    lost = [event for event in sink.events if event.data.get("reason") == "deck_lost"]
    assert len(lost) >= int(str(counters["deck.reconnects"]))


def test_a_deck_whose_images_are_not_read_skips_whole_ones() -> None:
    with ShownDeck(hz=1000.0) as shown, socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        client.connect(("127.0.0.1", shown.deck.port))
        waiting = threading.Event()
        while shown.deck.sent == 0 or shown.shown < 2 * shown.deck.sent:
            waiting.wait(0.01)
        sent = shown.deck.sent
        parser, assembly, got = PacketParser(), PictureAssembly(), 0
        while got < sent:
            got += sum(assembly.feed(packet) is not None for packet in parser.feed(client.recv(1 << 16)))
        assert assembly.broken == 0


def test_the_newer_program_is_told_apart_by_its_packets(wire: Wire) -> None:
    deck, stream, _ = wire
    picture = Picture(162, 162, Format.RAW, bytes(162 * 162), 1, 5)
    deck.sendall(on_wire(newer_packets(picture), Counting.DATA))
    (coded,) = all_of(stream, 1)
    assert coded.data == picture


def test_the_older_program_is_told_apart_by_its_packets(wire: Wire) -> None:
    deck, stream, _ = wire
    picture = Picture(32, 24, Format.RAW, bytes(32 * 24), 1)
    deck.sendall(on_wire(older_packets(picture)))
    (coded,) = all_of(stream, 1)
    assert coded.data == picture


# Its page ------------------------------------------------------------------------------------------------------------


def test_the_page_has_the_options_and_times() -> None:
    text = section("docs/crazyflie.md", "## The AI-deck's camera")
    told = {name for row in rows(text) for name in re.findall(r"`([^`]+)`", row[0])}
    assert told >= DECK_OPTIONS
    assert f"after {SILENT_S:g} s without a byte, or {PICTURELESS_S:g} s without a whole" in text
    first, last = live_video.RETRY_S[0], live_video.RETRY_S[-1]
    assert f"again after {first:g} s, then after growing pauses of up to {last:g} s" in text
    assert FUTILE == 3
    assert "three\nconnections in a row without an image" in text
    for size in SIZES:
        assert f"`{size}`" in text
