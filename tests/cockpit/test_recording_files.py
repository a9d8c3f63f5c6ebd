"""Recordings' files on the page: download, rename, annotate, delete; replays moved; with roles."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skyloop.client import Drone
from skyloop.cockpit import recording_files
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.recording_files import Mark, Notes, check_name, notes_path
from skyloop.cockpit.recordings import Recordings, timeline
from skyloop.drivers.registry import make_driver
from skyloop.errors import FileFormatError, RefusedError, UnknownNameError, UsageError
from skyloop.messages import Role
from skyloop.proxy.proxy import Proxy
from skyloop.recording.reader import Recording
from skyloop.transport.memory import MemoryServer
from tests.support.cockpit import ORIGIN, FakeRecorder, Node, Nodes, cockpit, this_user, until
from tests.support.recorded_flights import Plan, write_flight
from tests.support.testclient import TestClient


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_flight(tmp_path / "flight.mcap", Plan(seconds=1.0))
    write_flight(tmp_path / "other.mcap", Plan(seconds=0.5))
    return tmp_path


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    nodes = Nodes(Node("alpha"))
    yield nodes
    for node in nodes.nodes:
        node.stop()


def serve(nodes: Nodes, folder: Path, **options: Any) -> Any:
    gate = options.pop("gate", this_user())
    return cockpit(CockpitFleet(nodes, search_s=0.02), recordings=Recordings(folder, **options), gate=gate)


def post(client: TestClient, path: str, body: Any = None) -> Any:
    return client.post(f"/api/{path}", headers=ORIGIN, json={} if body is None else body)


# Names ---------------------------------------------------------------------------------------------------------------


@given(st.text(max_size=150))
@example("a" * 101)
@example("\u202egnp.mcap")
@example("\ud800")
def test_a_name_is_refused_or_is_one_file_of_the_folder(text: str) -> None:
    try:
        name = check_name(text)
    except UsageError:
        return
    assert Path(name).name == name
    assert name.endswith(".mcap")
    assert name[0] not in ".-"
    assert len(name.encode()) <= 255 - len(".notes.json") - 32
    assert all(unicodedata.category(character)[0] != "C" for character in name)
    assert check_name(name) == name


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the name is empty"),
        (".mcap", "the name is empty"),
        ("..", "begin with '.'"),
        ("../up", "contain '/'"),
        ("a\\b", "contain"),
        ("a\0b", "U+0000"),
        ("a\nb", "U+000A"),
        ("-rf", "begin with '-'"),
        ("x" * 101, "at most 100 characters"),
        ("🚁" * 60, "200 bytes"),
    ],
    ids=lambda value: ascii(value)[:20],
)
def test_hostile_names_are_refused_with_the_reason(nodes: Nodes, folder: Path, text: str, words: str) -> None:
    with serve(nodes, folder) as client:
        answer = post(client, "recordings/flight.mcap/rename", {"name": text})
        assert answer.status_code == 400
        assert words in answer.json()["error"]
    assert sorted(path.name for path in folder.iterdir()) == ["flight.mcap", "other.mcap"]


# Files ---------------------------------------------------------------------------------------------------------------


def test_a_recording_is_downloaded_whole_or_in_part(nodes: Nodes, folder: Path) -> None:
    data = (folder / "flight.mcap").read_bytes()
    (folder / "flight.mcap").rename(folder / "Flug über Köln.mcap")
    with serve(nodes, folder, gate=this_user(Role.OBSERVER)) as client:
        whole = client.get("/api/recordings/Flug%20%C3%BCber%20K%C3%B6ln.mcap/file")
        assert (whole.status_code, whole.content) == (200, data)
        assert whole.headers["content-disposition"] == "attachment; filename*=utf-8''Flug%20%C3%BCber%20K%C3%B6ln.mcap"
        assert whole.headers["x-content-type-options"] == "nosniff"
        path = "/api/recordings/Flug%20%C3%BCber%20K%C3%B6ln.mcap/file"
        part = client.get(path, headers={"range": "bytes=100-199"})
        assert (part.status_code, part.content) == (206, data[100:200])
        assert part.headers["content-range"] == f"bytes 100-199/{len(data)}"
        assert client.get(path, headers={"range": f"bytes={len(data)}-"}).status_code == 416
        for name in ("gone.mcap", "..%2Fflight.mcap", "%2Fetc%2Fpasswd", "flight.notes.json", "%00.mcap"):
            assert client.get(f"/api/recordings/{name}/file").status_code == 404


def test_observers_read_and_change_nothing(nodes: Nodes, folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with serve(nodes, folder, gate=this_user(Role.OBSERVER)) as client:
        assert client.get("/api/recordings/flight.mcap/notes").json() == {"text": "", "marks": []}
        for path, body in (
            ("recordings/flight.mcap/rename", {"name": "x"}),
            ("recordings/flight.mcap/delete", {}),
            ("recordings/flight.mcap/notes", {"text": "x"}),
            ("recordings/flight.mcap/marks", {"at_s": 1.0}),
            ("recordings/1/mark", {"text": "x"}),
            ("trash/empty", {}),
            ("replays/alpha", {"paused": True}),
        ):
            assert post(client, path, body).status_code == 403, path
            assert client.post(f"/api/{path}", json=body).status_code == 403, "not from another site's page"
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_renamed_recording_keeps_its_notes_and_overwrites_nothing(nodes: Nodes, folder: Path) -> None:
    with serve(nodes, folder) as client:
        assert post(client, "recordings/flight.mcap/notes", {"text": " windy \n"}).json()["text"] == "windy"
        taken = post(client, "recordings/flight.mcap/rename", {"name": "other"})
        assert (taken.status_code, "other.mcap already" in taken.json()["error"]) == (409, True)
        assert post(client, "recordings/flight.mcap/rename", {"name": " First flight "}).json() == {
            "name": "First flight.mcap"
        }
        (row,) = [one for one in client.get("/api/recordings").json()["past"] if one["name"] == "First flight.mcap"]
        assert (row["note"], row["marks"], row["drones"]) == ("windy", 0, ["alpha"])
        assert post(client, "recordings/First%20flight.mcap/rename", {"name": "First flight.mcap"}).status_code == 200
    assert sorted(path.name for path in folder.iterdir()) == [
        "First flight.mcap",
        "First flight.notes.json",
        "other.mcap",
    ]


def test_deleted_recordings_can_be_restored(nodes: Nodes, folder: Path) -> None:
    data = (folder / "flight.mcap").read_bytes()
    with serve(nodes, folder) as client:
        post(client, "recordings/flight.mcap/notes", {"text": "keep"})
        assert post(client, "recordings/flight.mcap/delete").json() == {"name": "flight.mcap"}
        listed = client.get("/api/recordings").json()
        assert [row["name"] for row in listed["past"]] == ["other.mcap"]
        assert listed["trash"] == {"count": 1, "bytes": len(data)}
        assert post(client, "trash/flight.mcap/restore").json() == {"name": "flight.mcap"}
        assert client.get("/api/recordings/flight.mcap/notes").json()["text"] == "keep"
        for name in ("gone.mcap", "..%2Fother.mcap"):
            assert post(client, f"trash/{name}/restore").status_code == 404
        post(client, "recordings/flight.mcap/delete")
        (folder / "flight.mcap").write_bytes(b"another one")
        assert post(client, "trash/flight.mcap/restore").status_code == 409, "nothing is overwritten"
        assert post(client, "recordings/flight.mcap/delete").json() == {"name": "flight (2).mcap"}
        assert client.get("/api/recordings").json()["trash"]["count"] == 2
        assert post(client, "trash/empty").status_code == 200
        assert list((folder / "trash").iterdir()) == []


def test_notes_and_marks_have_limits(folder: Path) -> None:
    path = folder / "flight.mcap"
    with pytest.raises(UsageError, match="at most 4000 characters"):
        recording_files.write_text(path, "x" * 4001)
    for at_s in (-1.0, float("nan"), float("inf"), 1e9):
        with pytest.raises(UsageError, match="a mark is at 0 to"):
            recording_files.add_mark(path, at_s, "")
    with pytest.raises(UsageError, match="at most 200 characters"):
        recording_files.add_mark(path, 1.0, "x" * 201)
    with pytest.raises(UsageError, match="at most 200 characters"):
        recording_files.remove_mark(path, Mark(1.0, "x" * 201))
    assert not notes_path(path).exists()
    for number in range(200):
        recording_files.add_mark(path, 200.0 - number, f"{number}")
    with pytest.raises(UsageError, match="remove one first"):
        recording_files.add_mark(path, 1.0, "")
    notes = recording_files.read_notes(path)
    assert [mark.at_s for mark in notes.marks] == [float(at_s) for at_s in range(1, 201)]
    assert len(recording_files.remove_mark(path, Mark(200.0, "0")).marks) == 199
    with pytest.raises(UnknownNameError):
        recording_files.remove_mark(path, Mark(200.0, "0"))
    notes_path(path).write_text("{what?")
    for change in (recording_files.read_notes, lambda path: recording_files.write_text(path, "new")):
        with pytest.raises(FileFormatError, match="is not notes"):
            change(path)
    assert notes_path(path).read_text() == "{what?", "what somebody wrote is never overwritten"
    notes_path(path).unlink()
    recording_files.write_text(path, "x")
    assert recording_files.write_text(path, "") == Notes()
    assert not notes_path(path).exists()


def test_running_recordings_can_be_marked_but_not_moved(nodes: Nodes, folder: Path) -> None:
    with serve(nodes, folder, record=FakeRecorder) as client:
        number = post(client, "recordings", {"drones": ["alpha"]}).json()["id"]
        (name,) = {path.name for path in folder.iterdir()} - {"flight.mcap", "other.mcap"}
        for path, body in ((f"recordings/{name}/delete", {}), (f"recordings/{name}/rename", {"name": "x"})):
            answer = post(client, path, body)
            assert (answer.status_code, "being recorded" in answer.json()["error"]) == (409, True)
        heard: list[Any] = []
        with nodes.nodes[0].connect("listener", access="observe") as drone:
            drone.on_log(heard.append, inline=True)
            until(lambda: post(client, f"recordings/{number}/mark", {"text": "gate 2"}).status_code == 200 and heard)
        assert (heard[0].name, heard[0].text) == ("mark", "gate 2")
        assert post(client, f"recordings/{number}/mark", {"text": "x" * 201}).status_code == 400
        assert post(client, "recordings/99/mark", {"text": "x"}).status_code == 404


# Replays -------------------------------------------------------------------------------------------------------------


def test_a_timeline_contains_events_and_marks(folder: Path) -> None:
    recording = Recording.open(folder / "flight.mcap")
    found = timeline(recording, "alpha")
    assert [event["kind"] for event in found["events"]].count("collision") == 1
    (collision,) = [event for event in found["events"] if event["kind"] == "collision"]
    assert (collision["at_s"], collision["severity"]) == (0.6, "warning")
    assert found["times"] == sorted(found["times"])
    assert len(found["times"]) == len(found["track"]) == pytest.approx(10, abs=1)
    assert {len(column) for column in found["values"].values()} == {len(found["times"])}
    assert {"altitude", "velocity.forward", "position.x"} <= set(found["values"])


class Played(Node):
    """A replay in this process."""

    def __init__(self, path: Path) -> None:
        self.name = "flight"
        self.stops_lost = 0
        self._server = MemoryServer("flight")
        self._proxy = Proxy(make_driver(f"replay://{path}?loop=1"), self._server, name="flight")
        self._proxy.start()
        self.up = True


def test_a_replay_is_moved_by_pilots_and_its_file_stays(nodes: Nodes, folder: Path) -> None:
    def replay(path: Path, _: str | None) -> Drone:
        nodes.nodes.append(Played(path))
        return nodes.nodes[-1].connect("cockpit", access="observe")

    def native(client: TestClient) -> dict[str, Any]:
        with nodes.nodes[-1].connect("look", access="observe") as drone:
            return dict(drone.next_feedback().native or {})

    with serve(nodes, folder, replay=replay) as client:
        assert post(client, "recordings/flight.mcap/replay", {"drone": 3}).status_code == 400
        assert post(client, "recordings/flight.mcap/replay").status_code == 201
        until(lambda: len(client.get("/api/drones").json()) == 2)
        answer = post(client, "replays/flight", {"paused": True, "position_s": 0.5, "speed": 2})
        assert answer.status_code == 200, answer.text
        until(lambda: native(client)["replay.position_s"] == 0.5)
        assert (native(client)["replay.paused"], native(client)["replay.speed"]) == (True, 2.0)
        for body, words in (({"position_s": 99.0}, "at most"), ({"speed": 0}, "at least"), ({"paused": 1}, "bool")):
            answer = post(client, "replays/flight", body)
            assert (answer.status_code in (400, 409), words in answer.json()["error"]) == (True, True)
        assert "is not a replay" in post(client, "replays/alpha", {"paused": True}).json()["error"]
        assert post(client, "replays/gone", {"paused": True}).status_code == 404
        for path, more in (("recordings/flight.mcap/delete", {}), ("recordings/flight.mcap/rename", {"name": "x"})):
            answer = post(client, path, more)
            assert (answer.status_code, "being replayed" in answer.json()["error"]) == (409, True)
        assert post(client, "recordings/flight.mcap/marks", {"at_s": 0.25, "text": "here"}).status_code == 201
        found = client.get("/api/replays/flight").json()
        assert (found["recording"], found["notes"]["marks"]) == ("flight.mcap", [{"at_s": 0.25, "text": "here"}])
        assert found["timeline"]["times"]
        assert client.get("/api/replays/alpha").status_code == 404


def test_a_move_that_would_overwrite_is_refused(folder: Path) -> None:
    with pytest.raises(RefusedError, match="already"):
        recording_files.rename(folder / "flight.mcap", "other")
    notes_path(folder / "new.mcap").write_text("{}")
    with pytest.raises(RefusedError, match="notes"):
        recording_files.rename(folder / "flight.mcap", "new")


def test_a_recording_is_renamed_where_links_have_fewer_options(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def link(*_: object, follow_symlinks: bool = True) -> None:
        assert not follow_symlinks
        raise NotImplementedError("link: follow_symlinks unavailable on this platform")

    monkeypatch.setattr("os.link", link)
    with pytest.raises(RefusedError, match="already"):
        recording_files.rename(folder / "flight.mcap", "other")
    recording_files.rename(folder / "flight.mcap", "moved")
    assert (folder / "moved.mcap").exists()
    assert not (folder / "flight.mcap").exists()
