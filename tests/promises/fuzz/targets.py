"""The fuzz targets. Each takes bytes, and returns or raises the kinds of :class:`skyloop.errors.SkyloopError` that its
documentation names; anything else is a finding."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

from skyloop.errors import DecodeError, FileFormatError, ParameterError, UsageError

DATA: Final = Path(__file__).parents[2] / "data"
CORPUS: Final = Path(__file__).parent / "corpus"


def samples(data: bytes) -> None:
    """A packet of the transports: what can be decoded can be encoded, and comes back unchanged."""
    from skyloop.messages import decode, encode

    with suppress(DecodeError):
        again = decode(encode(decode(data)))
        assert encode(decode(encode(again))) == encode(again)


def packets(data: bytes) -> None:
    """The packets that a transport's two ends exchange for their own purposes."""
    from skyloop.network import packets as fabric
    from skyloop.transport.local import packets as local

    for parse in (
        local.parse,
        local.parse_frame,
        fabric.parse,
        fabric.parse_number,
        fabric.parse_published,
        fabric.parse_frame,
    ):
        with suppress(DecodeError):
            parse(data)


def proxy(data: bytes) -> None:
    """A running proxy that gets packets from a client with or without a hello: it keeps running and raises nothing."""
    from skyloop.transport.base import Peer

    bench = _bench()
    peer = Peer(_next_peer(), "fuzz")
    bench.proxy.peer_joined(peer)
    for packet in _parts(data):
        bench.proxy.packet(peer, packet)
    bench.clock.advance(0.02)
    bench.proxy.tick(bench.clock())
    bench.proxy.peer_left(peer, "done")


def ardrone(data: bytes) -> None:
    """The data an AR.Drone, or an impostor, sends and receives."""
    from skyloop.vehicles.ardrone.wire import at, configuration, navdata
    from skyloop.vehicles.ardrone.wire.pave import PaveParser
    from skyloop.vehicles.ardrone.wire.uvlc import UvlcDecoder

    kind, data = data[:1], data[1:]
    if kind == b"n":
        whole = data + struct.pack("<HHI", 0xFFFF, 8, sum(data) & 0xFFFFFFFF)
        for datagram in (data, whole):
            with suppress(DecodeError):
                navdata.decode(datagram)
    elif kind == b"p":
        parser = PaveParser(1 << 16)
        half = len(data) // 2
        parser.feed(data[:half])
        parser.feed(data[half:])
        parser.end()
    elif kind == b"u":
        decoder = UvlcDecoder()
        for packet in (data, data):
            with suppress(DecodeError):
                decoder.decode(packet)
    elif kind == b"a":
        at.parse_commands(data)
    else:
        with suppress(DecodeError):
            configuration.parse_dump(data)


def tello(data: bytes) -> None:
    """The data a Tello sends."""
    from skyloop.drivers import h264
    from skyloop.vehicles.tello import wire
    from skyloop.vehicles.tello.wire import Assembly

    with suppress(DecodeError):
        wire.parse(data)
    wire.decoded(data)
    with suppress(DecodeError):
        sequence = h264.parse_sequence(data[: len(data) // 2])
        h264.parse_slice(data[len(data) // 2 :], sequence)
    pieces, inspector = Assembly(), h264.Inspector()
    for number, piece in enumerate(_parts(data)):
        pieces.feed(piece, number * 1_000_000)
        inspector.inspect(piece)


def mavlink(data: bytes) -> None:
    """The data of a MAVLink vehicle: in one datagram, as a stream, and as a stream cut into datagrams."""
    from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec

    MavlinkCodec(1, 1).decode(data, whole=True)
    stream, cut, signed = MavlinkCodec(1, 1), MavlinkCodec(1, 1), MavlinkCodec(1, 1, key=bytes(32))
    for number, part in enumerate(_parts(data)):
        stream.decode(part)
        cut.decode(part, whole=True, source=number % 3)
        signed.decode(part, whole=True)


def msp(data: bytes) -> None:
    """A flight controller's answers by MSP, and the requests an emulated one receives."""
    from skyloop.clock import NS_PER_S
    from skyloop.drivers.uri import parse_uri
    from skyloop.vehicles.msp.parameters import options_of
    from skyloop.vehicles.msp.protocol import MspSession
    from skyloop.vehicles.msp.wire.frames import Direction, MspFrame, encode

    session = MspSession(options_of(parse_uri("msp:///dev/ttyACM0")), 0)
    now_ns = 0
    for part in _parts(data):
        now_ns += NS_PER_S // 50
        session.poll(now_ns)
        session.receive(part, now_ns)
        if part:  # as a payload with a valid checksum
            session.receive(encode(MspFrame(part[0], part[1:], Direction.REPLY)), now_ns)
            session.receive(encode(MspFrame(0x2000 | part[0] & 3, part[1:], Direction.REPLY)), now_ns)
        session.drain()


def cpx(data: bytes) -> None:
    """What an AI-deck, or an impostor, sends: as a stream, and as packets with whole images in them."""
    from skyloop.vehicles.crazyflie.wire.cpx import Counting, Function, Packet, PacketParser, Target
    from skyloop.vehicles.crazyflie.wire.pictures import PictureAssembly

    assembly = PictureAssembly()
    for counting in (None, *Counting):
        with suppress(DecodeError):
            for packet in PacketParser(counting).feed(data):
                assembly.feed(packet)
    for number, part in enumerate(_parts(data)):
        function = Function.APP if number % 3 else Function.STREAMER
        assembly.feed(Packet(Target.GAP8, Target.HOST, function, part))


def vrpn(data: bytes) -> None:
    """The data a VRPN motion capture server, or an impostor, sends; the results are passed on as frames."""
    from skyloop.motion_capture.pose import plausible
    from skyloop.motion_capture.vrpn import Decoder, SensorSelection

    decoder, selection = Decoder(), SensorSelection(["Tracker"])
    with suppress(DecodeError):
        for number, part in enumerate(_parts(data)):
            for position, quaternion in selection.select(decoder.feed(part), number * 1_000_000_000).values():
                plausible(position, quaternion)


def recording(data: bytes) -> None:
    """A recording made by someone else: opened, and read completely."""
    from skyloop.recording.reader import Recording

    with _file(data) as path, suppress(FileFormatError, UsageError):
        found = Recording.open(path)
        for drone in found.drones[:4]:
            for item in found.items(drone.name):
                assert item is not None
            for camera in found.cameras(drone.name)[:2]:
                for picture in found.pictures(drone.name, camera):
                    with suppress(FileFormatError, UsageError):
                        picture.pixels()
        assert math.isfinite(found.seconds)


def files(data: bytes) -> None:
    """Files that people edit: worlds, calibrations, zones, tables of keys and of tokens."""
    from skyloop.calibration import load_calibration
    from skyloop.drivers.uri import parse_uri
    from skyloop.sim.world_file import load_world
    from skyloop.zones import parse_zones

    kind, data = data[:1], data[1:]
    if kind == b"w":
        with _file(data, ".toml") as path, suppress(FileFormatError):
            load_world(path)
    elif kind == b"c":
        with _file(data, ".json") as path, suppress(FileFormatError):
            load_calibration(path)
    elif kind == b"z":
        with suppress(UsageError, ParameterError):
            parse_zones(data.decode(errors="replace"))
    else:
        with suppress(UsageError):
            parse_uri(data.decode(errors="replace"))


def page(data: bytes) -> None:
    """The page's messages to the cockpit over its socket."""
    from skyloop.cockpit.commands import decode_command, decode_fleet_command, untimely

    with suppress(DecodeError):
        decode_command(data)
    with suppress(DecodeError):
        decode_command(data.decode(errors="surrogateescape"))
    with suppress(DecodeError):
        untimely(decode_command(data), 1000.0)
    with suppress(DecodeError):
        decode_fleet_command(data)


Target = Callable[[bytes], None]
TARGETS: Final[dict[str, Target]] = {
    target.__name__: target
    for target in (samples, packets, proxy, ardrone, tello, mavlink, msp, cpx, vrpn, recording, files, page)
}


def seeds(name: str) -> Iterator[bytes]:
    """Initial inputs: those of the corpus, and those the tests already have."""
    for file in sorted((CORPUS / name).glob("*")):
        yield file.read_bytes()
    if name in ("samples", "packets", "proxy"):
        for file in sorted((DATA / "packets").glob("*/*.bin")):
            content = file.read_bytes()
            if len(content) < 2000:
                yield content if name != "proxy" else _joined(_hello(), content)


def _parts(data: bytes) -> Iterator[bytes]:
    """Several packets in one input, each after its length in two bytes."""
    at = 0
    while at + 2 <= len(data):
        size = int.from_bytes(data[at : at + 2], "little")
        yield data[at + 2 : at + 2 + size]
        at += 2 + size


def _joined(*parts: bytes) -> bytes:
    return b"".join(len(part).to_bytes(2, "little") + part for part in parts)


def _hello() -> bytes:
    from skyloop.messages import Hello, Request, Role, encode

    return encode(Request(1, Hello("fuzz", Role.PILOT)))


@cache
def _bench() -> Any:
    from tests.support.proxy_bench import Bench

    bench = Bench()
    bench.__enter__()
    return bench


_peers = iter(range(1_000_000, 1 << 62))


def _next_peer() -> int:
    return next(_peers)


@contextmanager
def _file(data: bytes, suffix: str = ".mcap") -> Iterator[Path]:
    """A file with this content, in memory where that is possible."""
    folder = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path("/tmp")
    path = folder / f"skyloop-fuzz-{os.getpid()}{suffix}"
    path.write_bytes(data)
    try:
        yield path
    finally:
        path.unlink()
