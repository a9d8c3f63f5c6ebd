"""Recordings on the page: with a stand-in for the recorder, and with a real one."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect

from skyloop.client import Drone
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.recordings import Recordings
from skyloop.errors import LinkError, NoAnswerError, UnknownNameError
from skyloop.recording import Recorder, record
from skyloop.recording.listing import Described, describe
from tests.support.cockpit import ORIGIN, FakeRecorder, Node, Nodes, cockpit, open_socket, until
from tests.support.testclient import TestClient, WebSocketTestSession


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    nodes = Nodes(Node("alpha"), Node("beta"))
    yield nodes
    for node in nodes.nodes:
        node.stop()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "recordings"


def serve(nodes: Nodes, folder: Path, **options: Any) -> Any:
    return cockpit(CockpitFleet(nodes, search_s=0.02), recordings=Recordings(folder, **options))


def post(client: TestClient, path: str, body: Any = None) -> Any:
    return client.post(f"/api/{path}", headers=ORIGIN, json={} if body is None else body)


def read_on(socket: WebSocketTestSession) -> None:
    """Block forever."""
    while True:
        socket.receive_json()


def listing(client: TestClient) -> dict[str, Any]:
    found: dict[str, Any] = client.get("/api/recordings").json()
    return found


def test_a_recording_is_started_watched_and_stopped(nodes: Nodes, folder: Path) -> None:
    with serve(nodes, folder, record=FakeRecorder) as client:
        assert listing(client) == {
            "folder": str(folder),
            "running": [],
            "past": [],
            "trash": {"count": 0, "bytes": 0},
        }
        assert not folder.exists(), "made when it is needed"
        started = post(client, "recordings", {"drones": ["alpha", "beta"]})
        assert started.status_code == 201
        (running,) = listing(client)["running"]
        assert running == started.json()
        assert (running["drones"], running["seconds"], running["bytes"]) == (["alpha", "beta"], 1.5, 1000)
        assert running["dropped"] == {"alpha": {"video.front": 2}}
        assert running["state"] == "recording"
        assert listing(client)["past"] == [], "a file that is being written is not offered"
        with open_socket(client, "overview") as socket:
            assert [row["recording"] for row in socket.receive_json()["drones"]] == [True, True]
        stopped = post(client, f"recordings/{running['id']}/stop")
        assert stopped.json()["state"] == "closed"
        assert listing(client)["running"] == []
        (past,) = listing(client)["past"]
        assert (past["name"], past["size"]) == ("alpha-beta.mcap", 0)
        assert "nothing was recorded" in past["problem"]
        assert post(client, f"recordings/{running['id']}/stop").status_code == 404


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({"drones": ["gone"]}, 404),
        ({"drones": []}, 400),
        ({"drones": "alpha"}, 400),
        ({}, 400),
        ({"drones": ["alpha"] * 65}, 400),
    ],
)
def test_impossible_recordings_are_refused_with_the_reason(nodes: Nodes, folder: Path, body: Any, status: int) -> None:
    with serve(nodes, folder, record=FakeRecorder) as client:
        answer = post(client, "recordings", body)
        assert answer.status_code == status
        assert answer.json()["error"]
        assert not folder.exists()


def test_a_recorder_that_cannot_start_gives_the_reason(nodes: Nodes, tmp_path: Path) -> None:
    def fail(drones: Sequence[str], folder: Path) -> FakeRecorder:
        raise LinkError("the disk is on fire")

    with serve(nodes, tmp_path / "r", record=fail) as client:
        answer = post(client, "recordings", {"drones": ["alpha"]})
        assert (answer.status_code, answer.json()["error"]) == (502, "the disk is on fire")
    (tmp_path / "file").touch()
    with serve(nodes, tmp_path / "file" / "below", record=FakeRecorder) as client:
        answer = post(client, "recordings", {"drones": ["alpha"]})
        assert answer.status_code == 400
        assert "can't be created" in answer.json()["error"]


@pytest.mark.parametrize("name", ["gone.mcap", "..%2Fsecret.mcap", "secret.txt", "%2Fetc%2Fpasswd"])
def test_only_recordings_in_the_folder_are_served(nodes: Nodes, folder: Path, name: str) -> None:
    folder.mkdir()
    (folder / "secret.txt").touch()
    (folder.parent / "secret.mcap").touch()
    with serve(nodes, folder) as client:
        assert client.get(f"/api/recordings/{name}/report").status_code == 404
        assert post(client, f"recordings/{name}/replay").status_code == 404


def test_everything_is_closed_with_the_cockpit(nodes: Nodes, folder: Path) -> None:
    made: list[FakeRecorder] = []

    def start(drones: Sequence[str], where: Path) -> FakeRecorder:
        made.append(FakeRecorder(drones, where))
        return made[-1]

    with serve(nodes, folder, record=start) as client:
        post(client, "recordings", {"drones": ["alpha"]})
        assert not made[0].closed
    assert made[0].closed


def test_a_real_recording_is_listed_and_reported_on(nodes: Nodes, folder: Path) -> None:
    def start(drones: Sequence[str], where: Path) -> Recorder:
        connected: list[Drone | str] = [node.connect("me", access="observe") for node in nodes.nodes[:1]]
        opened.extend(drone for drone in connected if isinstance(drone, Drone))
        return record(connected, where / "flight.mcap")

    opened: list[Drone] = []
    with serve(nodes, folder, record=start) as client:
        number = post(client, "recordings", {"drones": ["alpha"]}).json()["id"]
        until(lambda: listing(client)["running"][0]["bytes"] > 0)
        post(client, f"recordings/{number}/stop")
        for drone in opened:
            drone.close()
        (past,) = listing(client)["past"]
        assert past["drones"] == ["alpha"]
        assert past["seconds"] >= 0
        assert past["problem"] == ""
        assert past["size"] == (folder / "flight.mcap").stat().st_size
        report = client.get("/api/recordings/flight.mcap/report")
        assert report.status_code == 200
        assert "alpha" in report.text
        policy = report.headers["content-security-policy"]
        assert policy.startswith("sandbox allow-scripts;"), "its script runs without this page's rights"
        assert "connect-src" not in policy
        assert client.get("/api/recordings/flight.mcap/report?drone=beta").status_code == 400


def test_a_replay_that_does_not_start_in_time_says_what_to_do(
    nodes: Nodes, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def busy(uri: str, *, timeout_s: float, **_: Any) -> Drone:
        assert timeout_s >= 60.0, "a computer under load takes long"
        raise NoAnswerError(f"the proxy for {uri} did not start in time")

    monkeypatch.setattr("skyloop.client.connect", busy)
    folder.mkdir()
    (folder / "flight.mcap").write_bytes(b"")
    with serve(nodes, folder) as client:
        answer = post(client, "recordings/flight.mcap/replay")
    assert answer.status_code == 502
    assert answer.json()["error"].startswith("the replay of flight.mcap has not started within 60 s: this computer is")


def test_a_replay_shows_up_and_can_be_ended(nodes: Nodes, folder: Path) -> None:
    gamma = Node("gamma")
    folder.mkdir()
    (folder / "flight.mcap").touch()
    played: list[Path] = []

    def replay(path: Path, drone: str | None) -> Drone:
        played.append(path)
        nodes.nodes.append(gamma)
        return gamma.connect("cockpit", access="observe")

    try:
        with serve(nodes, folder, replay=replay) as client:
            answer = post(client, "recordings/flight.mcap/replay")
            assert (answer.status_code, answer.json()) == (201, {"drone": "gamma"})
            assert played == [folder / "flight.mcap"]
            assert nodes.wanted == ["gamma"]
            until(lambda: len(client.get("/api/drones").json()) == 3)
            with open_socket(client, "overview") as socket:
                assert [row["replay"] for row in socket.receive_json()["drones"]] == [False, False, True]
            with open_socket(client, "drones/gamma/telemetry") as socket:
                socket.receive_json()
                gamma.stop()
                assert post(client, "replays/gamma/stop").json() == {"drone": "gamma"}
                with pytest.raises(WebSocketDisconnect) as ended:
                    read_on(socket)
                assert ended.value.code == 4404, "its pages are told that it is over"
            until(lambda: len(client.get("/api/drones").json()) == 2)
            assert post(client, "replays/gamma/stop").status_code == 404
    finally:
        gamma.stop()


def test_files_are_inspected_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[str] = []

    def look(path: Path) -> Described:
        looked.append(path.name)
        return describe(path)

    monkeypatch.setattr("skyloop.cockpit.recordings.describe", look)
    for name in ("a.mcap", "b.mcap", "notes.txt"):
        (tmp_path / name).touch()

    async def main() -> None:
        recordings = Recordings(tmp_path)
        for _ in range(3):
            assert len((await recordings.listing())["past"]) == 2
        (tmp_path / "a.mcap").write_bytes(b"other")
        await recordings.listing()
        with pytest.raises(UnknownNameError):
            await recordings.stop("1")

    asyncio.run(main())
    assert sorted(looked) == ["a.mcap", "a.mcap", "b.mcap"]


def test_the_page_starts_without_the_extra_for_recordings() -> None:
    """As after ``make demo`` and ``skyloop install cockpit``."""
    program = "import sys; sys.modules['mcap'] = None; import skyloop.cockpit.server, skyloop.cockpit.recordings"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
