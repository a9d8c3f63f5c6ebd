"""VRPN through our own client: trackers and their sensors; servers that fall silent, end, return, or are not VRPN."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import LinkError, UsageError
from skyloop.motion_capture import BodyPose, TrackEvent, TrackState, mocap, parse_system
from skyloop.motion_capture import vrpn as client
from skyloop.motion_capture.capture import MAX_UNKNOWN, MotionCapture
from skyloop.motion_capture.source import ChildSource, RawFrame
from skyloop.motion_capture.vrpn import COOKIE, SETTLE_S, SensorSelection, TrackerPose, split_name
from skyloop.transport.testing import wait_until
from tests.motion_capture import vrpn as server
from tests.motion_capture.moving import BODIES, pose
from tests.support.processes import Process

TRACKER = BODIES[0]
SECOND = 1_000_000_000
LATER = int(SETTLE_S * SECOND)


def report(tracker: str, sensor: int, x: float = 0.0) -> TrackerPose:
    return TrackerPose(tracker, sensor, (x, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))


# Assignment of sensors ------------------------------------------------------------------------------------------


def test_sensor_0_is_the_body_once_others_had_time_to_report() -> None:
    selection = SensorSelection(["Rig"])
    assert selection.select([report("Rig", 0)], 1) == {}
    assert not selection.settled(1)
    assert list(selection.select([report("Rig", 0)], 1 + LATER)) == ["Rig"]
    assert selection.settled(1 + LATER)
    assert selection.refused == {}


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_with_several_sensors_none_is_used_unless_named(order: tuple[int, ...]) -> None:
    selection = SensorSelection(["Rig"])
    selection.select([report("Rig", sensor) for sensor in order], 1)
    assert set(selection.select([report("Rig", 0)], SECOND)) == set()
    assert set(selection.select([report("Rig", 0), report("Rig", 1)], 2 * SECOND)) == {"Rig:1"}, "only for display"
    assert "reports sensors 0, 1" in selection.refused["Rig"]
    assert "'Rig:0'" in selection.refused["Rig"]


def test_a_single_sensor_other_than_0_is_not_taken_for_it() -> None:
    selection = SensorSelection(["Rig"])
    selection.select([report("Rig", 3)], 1)
    assert "Rig" not in selection.select([report("Rig", 3)], SECOND)
    assert "reports sensor 3" in selection.refused["Rig"]
    assert "?sensor=3" in selection.refused["Rig"]


def test_a_sensor_that_appears_later_ends_the_guess() -> None:
    selection = SensorSelection(["Rig"])
    selection.select([report("Rig", 0)], 1)
    assert "Rig" in selection.select([report("Rig", 0)], SECOND)
    assert "Rig" not in selection.select([report("Rig", 0), report("Rig", 1)], SECOND + 1), "in the same piece"
    assert "Rig" not in selection.select([report("Rig", 0)], 9 * SECOND), "even when it is no longer seen"


def test_each_body_has_its_own_sensor_and_the_newest_pose() -> None:
    selection = SensorSelection(["Rig:0", "Rig:2", "Wand"], sensor=1)
    found = selection.select(
        [
            report("Rig", 0, 1.0),
            report("Rig", 2, 2.0),
            report("Rig", 2, 3.0),
            report("Wand", 1, 4.0),
            report("Wand", 0),
        ],
        1,
    )
    assert {name: seen[0][0] for name, seen in found.items()} == {
        "Rig:0": 1.0,
        "Rig:2": 3.0,
        "Wand": 4.0,
        "Wand:0": 0.0,
    }
    assert selection.refused == {}
    assert selection.settled(1)


def test_two_names_for_one_sensor_are_refused() -> None:
    for names, sensor in ((["Rig", "Rig:0"], None), (["Rig", "Rig:2"], 2)):
        with pytest.raises(UsageError, match=r"'Rig' and 'Rig:\d' are both sensor \d of tracker 'Rig'"):
            SensorSelection(names, sensor)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("Rig", ("Rig", None)),
        ("Rig:2", ("Rig", 2)),
        ("Rig:1:0", ("Rig:1", 0)),
        ("Rig:", ("Rig:", None)),
        ("Rig:x", ("Rig:x", None)),
        (":2", (":2", None)),
        ("Rig:\u0662", ("Rig:\u0662", None)),
        ("Rig:1234567890", ("Rig:1234567890", None)),
    ],
)
def test_names_of_bodies(name: str, meant: tuple[str, int | None]) -> None:
    assert split_name(name) == meant


@given(
    st.lists(st.lists(st.tuples(st.sampled_from(["A", "B", "A:-5"]), st.integers(-5, 3)), max_size=4), max_size=8),
    st.sampled_from([None, 0, 2]),
)
def test_a_body_never_has_the_pose_of_another_sensor(pieces: list[list[tuple[str, int]]], sensor: int | None) -> None:
    names = ["A", "A:3", "A:-5", "B:1"]
    selection = SensorSelection(names, sensor)
    for number, piece in enumerate(pieces):
        found = selection.select([report(tracker, n, n) for tracker, n in piece], number * LATER)
        assert {found[name][0][0] for name in ("A", "A:-5") if name in found} <= {float(sensor or 0)}
        assert {found[name][0][0] for name in ("A:3",) if name in found} <= {3.0}
        assert {found[name][0][0] for name in ("B:1",) if name in found} <= {1.0}
        others = {n for tracker, n in (one for before in pieces[: number + 1] for one in before) if tracker == "A"}
        assert not ("A" in found and sensor is None and others - {0})


def test_a_server_that_invents_sensors_costs_no_memory() -> None:
    selection = SensorSelection(["Rig"])
    taken = MotionCapture(parse_system("vrpn://h"), {"alpha": "Rig"}, client.VrpnSource)
    for sensor in range(3 * client.MAX_SENSORS):
        taken._take(RawFrame(sensor, selection.select([report("Rig", sensor)], sensor)))
    assert len(selection._reported["Rig"][1]) == client.MAX_SENSORS
    assert len(taken.unknown) == MAX_UNKNOWN
    assert len(selection.refused["Rig"]) < 400


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("vrpn://h/Rig", r"name the tracker in bodies, as \{'alpha': 'Rig'\}"),
        ("vrpn://h?sensor=-1", "sensor is '-1' and must be a whole number from 0"),
        ("vrpn://h?sensor=", "sensor is ''"),
        ("vicon://h?sensor=1", "sensor is for vrpn:// only"),
    ],
)
def test_wrong_addresses(address: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        parse_system(address)


def test_an_address_says_the_sensor() -> None:
    assert parse_system("vrpn://h").sensor is None
    assert parse_system("vrpn://h/?sensor=2").sensor == 2


# Against servers ------------------------------------------------------------------------------------------------


@contextmanager
def listening(answer: Callable[[socket.socket], None]) -> Iterator[str]:
    """Run a server that answers each connection in turn; yield its address."""

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                try:
                    answer(connection)
                except OSError:
                    continue

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"vrpn://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)


def streaming(*sensors: int) -> Callable[[socket.socket], None]:
    return lambda connection: server.stream(connection, list(sensors), threading.Event())


def test_several_sensors_of_a_tracker_are_refused_with_what_to_do() -> None:
    with (
        listening(streaming(0, 1, 4)) as address,
        pytest.raises(UsageError, match=r"tracker 'alpha_body' reports sensors 0, 1, 4.* as 'alpha_body:0', or"),
    ):
        mocap(address, {"alpha": TRACKER})


@pytest.mark.parametrize(
    ("option", "body", "sensor"), [("", f"{TRACKER}:1", 1), ("?sensor=1", TRACKER, 1), ("?sensor=1", f"{TRACKER}:0", 0)]
)
def test_only_the_named_sensor_is_the_body(option: str, body: str, sensor: int) -> None:
    seen: list[BodyPose] = []
    with listening(streaming(0, 1)) as address, mocap(address + option, {"alpha": body}) as capture:
        with capture.on_pose(seen.append, inline=True):
            wait_until(lambda: len(seen) >= 50, "poses came")
        assert capture.unknown == {f"{TRACKER}:{1 - sensor}"}
    place, _ = pose(1)
    assert {one.position_m[0] for one in seen} == {place[0] + server.APART_M * sensor}


def test_two_drones_fly_by_two_sensors_of_one_tracker() -> None:
    bodies = {"alpha": f"{TRACKER}:0", "beta": f"{TRACKER}:1"}
    with listening(streaming(0, 1)) as address, mocap(address, bodies) as capture:
        apart = capture.wait("beta").position_m[0] - capture.wait("alpha").position_m[0]
    assert apart == pytest.approx(server.APART_M)


def test_a_sensor_that_appears_in_flight_loses_the_body_with_the_reason() -> None:
    both = threading.Event()
    events: list[TrackEvent] = []

    def answer(connection: socket.socket) -> None:
        connection.sendall(COOKIE + server.descriptions())
        for number in range(1, 10_000):
            connection.sendall(server.frame(number) + (server.frame(number, 1) if both.is_set() else b""))
            time.sleep(0.01)

    with (
        listening(answer) as address,
        mocap(address, {"alpha": TRACKER}) as capture,
        capture.on_event(events.append, inline=True),
    ):
        capture.wait("alpha")
        both.set()
        wait_until(lambda: capture.state("alpha") is TrackState.LOST, "it was lost")
        assert capture.pose("alpha") is None
    assert len([event for event in events if "reports sensors 0, 1" in event.text]) == 1


def test_a_restarted_server_is_found_again() -> None:
    events: list[TrackEvent] = []
    with ExitStack() as stack:
        first = stack.enter_context(running("0"))
        port = first.text.split("ready ")[1].split()[0]
        capture = stack.enter_context(mocap(f"vrpn://127.0.0.1:{port}", {"alpha": TRACKER}))
        stack.enter_context(capture.on_event(events.append, inline=True))
        capture.wait("alpha")
        first.end()
        wait_until(lambda: capture.state("alpha") is TrackState.LOST, "it was lost")
        assert capture.pose("alpha") is None
        stack.enter_context(running(port))
        capture.wait("alpha", 20.0)
    assert any("no data from" in event.text for event in events)
    assert any("is tracked again" in event.text for event in events)


@contextmanager
def running(*arguments: str) -> Iterator[Process]:
    process = Process("-m", "tests.motion_capture.vrpn", *arguments)
    try:
        process.until("ready")
        yield process
    finally:
        process.end()


def test_a_silent_connection_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "SILENT_S", 0.3)
    events: list[TrackEvent] = []
    connections = []

    def answer(connection: socket.socket) -> None:
        connections.append(1)
        connection.sendall(COOKIE + server.descriptions())
        for number in range(len(connections) * 100, len(connections) * 100 + 50):
            connection.sendall(server.frame(number))
            time.sleep(0.01)
        while connection.recv(1000):
            pass

    with (
        listening(answer) as address,
        mocap(address, {"alpha": TRACKER}) as capture,
        capture.on_event(events.append, inline=True),
    ):
        capture.wait("alpha")
        wait_until(lambda: len(connections) >= 2, "it was connected to again")
        capture.wait("alpha")
    assert any("sent no pose for 0.3 s" in event.text for event in events)


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "a VRPN server of version 7 begins with"),
        (COOKIE + b"\xff" * 24, "a VRPN message has from 24 to"),
        (COOKIE[:10], "the server ended the connection"),
    ],
)
def test_other_servers_are_a_link_error_with_the_reason(sent: bytes, said: str) -> None:
    with listening(lambda connection: connection.sendall(sent)) as address, pytest.raises(LinkError, match=said):
        mocap(address, {"alpha": "x"}, timeout_s=0.5)


def test_silent_servers_and_impossible_hosts_are_link_errors() -> None:
    with listening(lambda connection: time.sleep(0.5)) as address:
        begin = time.monotonic()
        with pytest.raises(LinkError, match=r"sent no frame within 0\.2 s"):
            mocap(address, {"alpha": "x"}, timeout_s=0.2)
        assert time.monotonic() - begin < 3.0
    with pytest.raises(LinkError, match="sent no frame within"):
        mocap(f"vrpn://{'a' * 70}.invalid", {"alpha": "x"}, timeout_s=0.5)


def test_a_backlog_is_one_frame_with_the_newest_pose() -> None:
    taken: list[RawFrame] = []
    sent = threading.Event()

    def answer(connection: socket.socket) -> None:
        connection.sendall(COOKIE + server.descriptions() + b"".join(map(server.frame, range(1, 201))))
        sent.wait(20.0)

    with listening(answer) as address:
        source = client.VrpnSource(parse_system(address + "?sensor=0"), [TRACKER], taken.append, lambda _: None)
        source.start(20.0)
        wait_until(lambda: taken[-1].bodies[TRACKER][0] == pose(200)[0], "the last one came")
        sent.set()
        source.close()
        source.close()
    assert len(taken) < 20


def test_the_reference_client_reads_what_our_codec_writes() -> None:
    """The package's client is compiled from the reference implementation."""
    pytest.importorskip("motioncapture", reason="needs the motioncapture package: skyloop install mocap")
    try:
        socket.getprotobyname("tcp")
    except OSError:
        pytest.skip("the reference client can't look up protocols here: install /etc/protocols (Debian: netbase)")
    taken: list[RawFrame] = []
    with running("0") as process:
        port = process.text.split("ready ")[1].split()[0]
        source = ChildSource(parse_system(f"vrpn://127.0.0.1:{port}"), taken.append, lambda _: None)
        try:
            source.start(20.0)
            wait_until(lambda: sum(TRACKER in frame.bodies for frame in taken) >= 50, "poses came")
        finally:
            source.close()
    for frame in taken:
        for place, (x, y, z, w) in frame.bodies.values():
            number = round((place[2] - 1.0) * 1000)
            wanted, yaw = pose(number)
            assert place == pytest.approx(wanted, abs=1e-6)
            assert (x, y) == (0.0, 0.0)
            assert math.remainder(2.0 * math.atan2(z, w) - yaw, math.tau) == pytest.approx(0.0, abs=1e-5)
