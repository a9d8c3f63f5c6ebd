"""Files from others: each bad one is refused with a clear error, in little time, whatever it contains."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.recorded_steps import read_recording
from skyloop.calibration import load_calibration
from skyloop.cockpit.access import read_tokens
from skyloop.drivers.uri import parse_uri
from skyloop.errors import FileFormatError, UsageError
from skyloop.network.keys import Lab
from skyloop.sim.world_file import load_world
from skyloop.vehicles.mavlink.options import options_of

ROOM = b"[room]\nsize = [8, 6, 3]\n"
DEEP = b"a." * 100_000 + b"a = 1\n"
WORLDS = {
    "dotted keys": DEEP,
    "a dotted table": b"[" + b"a." * 20_000 + b"a]\n" + b"x = 1\n" * 10_000,
    "quoted dotted keys": b'"a".' * 20 + b"a = 1\n",
    "spaced dotted keys": b"a . " * 20 + b"a = 1\n",
    "many deep keys": b"".join(b"a." * 15 + b"k%d = 1\n" % number for number in range(7000)),
    "lists within lists": ROOM + b"x = " + b"[" * 100_000 + b"]" * 100_000,
    "tables within tables": ROOM + b"x = " + b"{a=" * 20_000 + b"1" + b"}" * 20_000,
    "a huge number": b"[room]\nsize = [" + b"9" * 100_000 + b", 6, 3]\n",
    "a rather huge number": b"[room]\nsize = [" + b"9" * 400 + b", 6, 3]\n",
    "a huge number in hexadecimal": b"[room]\nsize = [0x" + b"f" * 100_000 + b", 6, 3]\n",
    "a huge exponent": b"[room]\nsize = [1e999999999, 6, 3]\n",
    "a huge seed": ROOM + b'[[marker]]\non = "north"\nat = [0, 1]\nmarker_size = 0.3\nid = ' + b"9" * 4000 + b"\n",
    "a date of no year": ROOM + b"x = 0000-00-00\n",
    "a long text": b'[room]\nsize = "' + b"x" * 200_000 + b'"\n',
    "too much": b"#" * (1 << 24),
    "no text": b"\xff\xfe\x00\x00",
    "nothing": b"",
}


def refused(read: Callable[[Path], object], path: Path, content: bytes) -> str:
    path.write_bytes(content)
    began = time.process_time()
    with pytest.raises(UsageError) as refusal:
        read(path)
    assert time.process_time() - began < 2.0
    assert str(path.name) in str(refusal.value)
    assert len(str(refusal.value)) < 1000
    return str(refusal.value)


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_file(name: str, tmp_path: Path) -> None:
    refused(load_world, tmp_path / "x.toml", WORLDS[name])


def test_text_with_dots_is_not_a_nested_key(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(ROOM + b"# 1.2.3.4.5.6.7.8.9.10.11.12.13.14 and so on\n")
    assert load_world(path).room.size_m == (8.0, 6.0, 3.0)


CALIBRATION = b'{"width":640,"height":480,"model":"pinhole","fx":%s,"fy":1,"cx":1,"cy":1,"distortion":%s}'


@pytest.mark.parametrize(
    "content",
    [
        CALIBRATION % (b"1e400", b"[]"),
        CALIBRATION % (b"9" * 400, b"[]"),
        CALIBRATION % (b"1", b"[" * 50_000 + b"]" * 50_000),
        b"[" * 100_000,
        b'{"x":' + b"[" * 100_000,
        b" " * (1 << 22),
        b"\xff",
        b"",
    ],
    ids=["large", "huge", "nested", "lists", "unknown", "too much", "no text", "nothing"],
)
def test_a_calibration(content: bytes, tmp_path: Path) -> None:
    refused(load_calibration, tmp_path / "x.json", content)


def test_tokens_and_tracks_and_keys(tmp_path: Path) -> None:
    def tokens(path: Path) -> object:
        path.chmod(0o600)
        return read_tokens(path)

    refused(tokens, tmp_path / "tokens", b"\xff")
    refused(tokens, tmp_path / "tokens", b"pilot " + b"x" * 100_000)
    refused(tokens, tmp_path / "tokens", b"#" * (1 << 24))
    for track in (b"x" * 100_000, b"1 1e999\n2 2\n", b"\xff", b"1 2\n" * (5 << 20)):
        refused(lambda path: read_recording(path.parent), tmp_path / "command_dump.dat", track)
    for key in (b"", b"x" * 63, b"\0" * (1 << 24)):
        refused(lambda path: options_of(parse_uri(f"mavlink://127.0.0.1?signing_key={path}")), tmp_path / "k", key)


def test_a_roster(tmp_path: Path) -> None:
    lab = Lab.make(tmp_path / "lab")
    for content in (b'{"roster":' + b"[" * 100_000, b"[" * 100_000, b"x" * (1 << 25), b"\xff", b"{}"):
        refused(lambda path: Lab.open(path.parent).roster, tmp_path / "lab" / "roster.json", content)
    assert isinstance(lab, Lab)
    assert issubclass(FileFormatError, UsageError)
