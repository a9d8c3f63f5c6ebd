"""``skyloop sim --firmware``: an emulated drone as a separate process."""

from __future__ import annotations

import os
import re
import signal
import socket
from collections.abc import Callable

import pytest

from skyloop.cli.sim import address_from, ports_from
from skyloop.errors import UsageError
from skyloop.vehicles.ardrone.emulator import Ports
from tests.support.ardrone_pilot import HERE, Pilot
from tests.support.commands import Run
from tests.support.processes import Process

pytest.importorskip("av")


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_says_where_it_listens_and_ends_on_request(start: Callable[..., Process], number: signal.Signals) -> None:
    process = start(
        *("sim", "--firmware", "ardrone2", "--drones", "2", "--world", "empty", "--port-base", "0"),
        *("--lose", "0.05", "--delay", "0.001", "--repeat", "0.05", "--reorder", "0.05", "--fault-seed", "7"),
    )
    process.until("control tcp", 20.0)
    process.until("drone 1 on 127.0.0.1")
    found = re.search(
        r"ready ardrone2 drone 0 on 127.0.0.1: at udp (\d+), navdata udp (\d+), video tcp (\d+), control tcp (\d+)\n",
        process.text,
    )
    assert found, process.text
    at, navdata, video, control = map(int, found.groups())
    with Pilot(Ports(navdata, video, at, control)) as pilot:
        pilot.configure("general:navdata_demo", "TRUE")
        pilot.until(lambda n: n.options, "it tells")
    process.signal(number)
    assert process.wait() == 0


@pytest.mark.process
def test_tellos_have_an_address_each(start: Callable[..., Process]) -> None:
    pid = os.getpid()
    first = f"127.{128 + (pid >> 8) % 64}.{pid & 0xFF}.10"
    process = start(
        "sim", "--firmware", "tello", "--drones", "2", "--world", "empty", "--bind", first, "--lose", "0.01"
    )
    process.until(f"drone 1 on {address_from(first, 1)}: commands udp 8889", 20.0)
    assert f"ready tello drone 0 on {first}: commands udp 8889, SDK 3.0" in process.text
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pilot:
        pilot.settimeout(0.2)
        for _ in range(50):
            pilot.sendto(b"command", (address_from(first, 1), 8889))
            try:
                assert pilot.recv(100) == b"ok"
            except TimeoutError:
                continue
            break
        else:
            raise AssertionError("it did not answer")
    process.signal(signal.SIGTERM)
    assert process.wait() == 0


def test_addresses_count_from_a_base() -> None:
    assert address_from("no address", 0) == "no address"
    assert address_from("127.0.0.255", 2) == "127.0.1.1"
    with pytest.raises(UsageError, match="several Tellos need an IPv4 address"):
        address_from("localhost", 1)


def test_ports_count_from_a_base() -> None:
    assert ports_from(5550, 0) == Ports()
    assert ports_from(5550, 1) == Ports(5564, 5565, 5566, 5569)
    assert ports_from(0, 3) == Ports(0, 0, 0, 0)
    with pytest.raises(UsageError, match="65535"):
        ports_from(65000, 60)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--lose", "0.1"), "--lose is for --firmware: give --firmware ardrone2 as well"),
        (("--bind", "0.0.0.0"), "--bind is for --firmware"),
        (("--firmware", "ardrone2", "--name", "mine"), "--name is the proxy's"),
        (("--firmware", "ardrone2", "--option", "cameras=front"), "--option cameras can't be set with --firmware"),
        (
            ("--firmware", "ardrone3"),
            "'ardrone3' is none of 'ardrone1', 'ardrone2', 'arducopter', 'betaflight', 'crazyflie', 'esp-drone', "
            "'px4', 'tello'",
        ),
        (("--firmware", "betaflight", "--lose", "0.1"), "--lose and --delay are for datagrams"),
        (("--firmware", "ardrone2", "--lose", "1.5"), "--lose: must be at most 1"),
        (("--firmware", "ardrone2", "--port-base", "0", "--bind", "no such host"), "can't be opened"),
    ],
)
def test_nonsense_is_refused(run: Run, arguments: tuple[str, ...], said: str) -> None:
    ended = run("sim", "--world", "empty", *arguments)
    assert ended.code != 0
    assert said in ended.err


def test_a_port_that_is_taken_is_named(run: Run) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HERE, 0))
        base = other.getsockname()[1] - 4
        ended = run("sim", "--world", "empty", "--firmware", "ardrone2", "--port-base", str(base))
    assert ended.code == 1
    assert f"the drone's navdata port, UDP {base + 4} on 127.0.0.1, can't be opened" in ended.err


def test_the_autopilots_ports() -> None:
    from skyloop.vehicles.mavlink.emulator import Kind
    from skyloop.vehicles.mavlink.emulator import Ports as MavlinkPorts

    assert MavlinkPorts.counted(Kind.PX4, None, 1) == MavlinkPorts(14581, 14541)
    assert MavlinkPorts.counted(Kind.ARDUCOPTER, None, 1) == MavlinkPorts(5773, 14560, 5770)
    assert MavlinkPorts.counted(Kind.ARDUCOPTER, 7000, 2) == MavlinkPorts(7020, 7021, 7022)
    assert MavlinkPorts.counted(Kind.PX4, 7000, 0) == MavlinkPorts(7000, 7001)
    with pytest.raises(UsageError, match="65535"):
        MavlinkPorts.counted(Kind.PX4, 65000, 60)


@pytest.mark.process
def test_several_autopilots_say_where_they_are_and_end_on_request(start: Callable[..., Process]) -> None:
    process = start("sim", "--firmware", "px4", "--drones", "2", "--world", "empty", "--port-base", "0")
    process.until("drone 1, system 2", 20.0)
    assert re.search(r"ready px4 drone 0, system 1, from udp \d+: mavlink://udpin:127.0.0.1:\d+\n", process.text)
    process.signal(signal.SIGTERM)
    assert process.wait() == 0


@pytest.mark.process
@pytest.mark.parametrize(("firmware", "hello"), [("crazyflie", b"\xf3"), ("esp-drone", b"\xf3\xf3")])
def test_crazyflies_answer_on_their_ports(start: Callable[..., Process], firmware: str, hello: bytes) -> None:
    process = start("sim", "--firmware", firmware, "--drones", "2", "--world", "empty", "--port-base", "0")
    process.until("drone 1 on", 20.0)
    ports = re.findall(rf"ready {firmware} drone \d on 127.0.0.1: CRTP udp (\d+)\n", process.text)
    assert len(ports) == 2
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.settimeout(10.0)
            client.sendto(hello, (HERE, int(port)))
            assert client.recv(64) == hello
    process.signal(signal.SIGTERM)
    assert process.wait() == 0


def test_an_ardrone_has_a_video_port_of_its_own(run: Run) -> None:
    ended = run("sim", "--firmware", "ardrone2", "--video-port", "5600")
    assert ended.code == 2
    assert "the others have their own port" in ended.err
