"""Files are read up to a limit and with one kind of error, and are written whole or not at all."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

import skyloop.sim
from skyloop.cockpit.access import read_tokens
from skyloop.control.route import Route, RouteWaypoint, load_route
from skyloop.errors import FileFormatError, UsageError
from skyloop.files import expand, read_bytes, read_json, read_text, replacing, write
from skyloop.host.fleet import read_fleet
from skyloop.platform import wait_readable
from skyloop.sim.world_file import load_world
from tests.support.systems import only_on


@only_on("linux", "darwin", reason="select counts sockets there, whatever their numbers")
def test_a_descriptor_of_any_number_is_waited_for() -> None:
    """``select.select`` raises for 1,024 and more, and a ground station with many drones has as many."""
    import fcntl
    import resource

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(limits[0], 2048), max(limits[1], 2048)))
    reader, writer = os.pipe()
    high = fcntl.fcntl(reader, fcntl.F_DUPFD, 1500)
    try:
        assert high >= 1500
        assert not wait_readable(high, 0.001)
        os.write(writer, b".")
        assert wait_readable(high, 10.0)
        os.read(high, 1)
        os.close(writer)
        writer = -1
        assert wait_readable(high, 10.0), "its end counts as well"
    finally:
        for descriptor in filter(lambda number: number >= 0, (reader, writer, high)):
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_nothing_in_the_package_waits_by_select() -> None:
    package = Path(skyloop.__file__).parent
    found = {path.name for path in package.rglob("*.py") if "select.select(" in path.read_text(encoding="utf-8")}
    on_windows_only = {"platform.py", "portable.py"}
    assert found == on_windows_only, "skyloop.platform.wait_readable takes descriptors of all numbers"


def test_a_file_is_replaced_in_one_step(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    write(path, b"old")
    path.chmod(0o640)
    with replacing(path) as part:
        part.write_bytes(b"new")
        assert part.suffix == ".txt", "some writers go by it"
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert [path.name for path in tmp_path.iterdir()] == ["x.txt"]


def test_a_file_is_flushed_as_windows_demands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There, ``FlushFileBuffers`` needs write access, and Python reports a bad descriptor without it."""
    fcntl = pytest.importorskip("fcntl")
    flushed: list[int] = []

    def fsync(descriptor: int) -> None:
        flushed.append(fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE)

    monkeypatch.setattr(os, "fsync", fsync)
    write(tmp_path / "x.txt", b"new")
    assert flushed == [os.O_RDWR]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_bytes(b"old")

    def fail(error: Exception) -> None:
        with replacing(path) as part:
            part.write_bytes(b"half")
            raise error

    with pytest.raises(KeyError):
        fail(KeyError("x"))
    with pytest.raises(UsageError, match=r"x\.txt can't be written: No space left on device"):
        fail(OSError(28, os.strerror(28)))
    assert path.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["x.txt"]
    with pytest.raises(UsageError, match="can't be written: No such file"):
        write(tmp_path / "gone" / "x.txt", b"")


def test_a_link_stays_and_a_device_is_written_to(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "x.txt")
    write(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "x.txt").read_bytes() == b"new"
    write(Path(os.devnull), b"gone")
    assert stat.S_ISCHR(Path(os.devnull).stat().st_mode)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_texts_are_read_with_and_without_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    """Editors of Windows begin a text with one, and it was taken for a part of the first word."""

    def file(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text, encoding=encoding)
        path.chmod(0o600)
        return path

    assert read_text(file("text", "Zoë\n"), "the text", 99) == "Zoë\n"
    assert read_json(file("list", "[1]"), list[int], "a list", 99) == [1]
    assert read_fleet(file("fleet.toml", 'name = "lab"\n')).name == "lab"
    assert [one.person.name for one in read_tokens(file("tokens", "pilot 0123456789abcdef ann\n"))] == ["ann"]
    shipped = Path(skyloop.sim.__file__).parent / "worlds" / "empty.toml"
    assert load_world(file("mine.toml", shipped.read_text(encoding="utf-8"))).name == "mine"
    route = Route(waypoints=(RouteWaypoint(x=0.0, y=0.0, z=1.0),))
    assert load_route(file("route.json", route.to_json().decode())) == route


def test_reading_has_one_kind_of_error(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"\xff[1]")
    with pytest.raises(FileFormatError, match=r"the list .*gone can't be read: No such file"):
        read_bytes(tmp_path / "gone", "the list", 10)
    with pytest.raises(FileFormatError, match="is larger than 3 bytes"):
        read_bytes(path, "the list", 3)
    with pytest.raises(FileFormatError, match="is not UTF-8"):
        read_text(path, "the list", 10)
    for content in (b"\xff[1]", b"[1", b'["x"]', b"[" * 100_000, b"9" * 5000, b""):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match="x is not a list"):
            read_json(path, list[int], "a list", 1 << 20)
    path.write_bytes(b"[1]")
    assert read_json(path, list[int], "a list", 10) == [1]
    with pytest.raises(FileFormatError):
        read_bytes("/dev/zero", "the list", 1000)
    assert str(expand("~nobody-of-this-name/x")) == "~nobody-of-this-name/x"
