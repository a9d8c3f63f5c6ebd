"""Processes that the cockpit starts on request: few at a time, ended with the requester, none for foreign pages."""

from __future__ import annotations

import asyncio
import http.client
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from skyloop.cockpit import recordings as recordings_module
from skyloop.cockpit.recordings import MAX_CHILDREN, MAX_WAITING, Recordings, Reports
from skyloop.cockpit.security import foreign, own_names
from skyloop.errors import LinkError, RefusedError, UsageError
from skyloop.recording.listing import describe
from tests.support.cockpit import FakeRecorder
from tests.support.cockpit_page import served

ASKED = 30
NAMES = own_names("127.0.0.1", 8123)


class Children:
    """Commands of children that report that they run, and then do nothing until they are stopped."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "running").mkdir()
        self.started = 0

    def command(self, file: Path, target: Path, drone: str | None) -> Sequence[str]:
        self.started += 1
        go, mark = self.folder / "go", self.folder / "running" / str(self.started)
        return ["sh", "-c", f"echo $$ > {mark}; while [ ! -e {go} ]; do sleep 0.01; done; echo done > {target}"]

    def pids(self) -> list[int]:
        """The process ids of those that are alive."""
        written = [path.read_text().strip() for path in (self.folder / "running").iterdir()]
        return [int(pid) for pid in written if pid and Path(f"/proc/{pid}").exists()]

    async def running(self, many: int) -> None:
        async with asyncio.timeout(10):
            while len(self.pids()) != many:
                await asyncio.sleep(0.005)


def test_reports_are_made_one_at_a_time_and_few_may_wait(tmp_path: Path) -> None:
    children = Children(tmp_path)

    async def main() -> None:
        reports = Reports(children.command)
        wanted = [asyncio.create_task(reports.make(tmp_path / "a.mcap")) for _ in range(ASKED)]
        await children.running(1)
        refused = [task for task in wanted if task.done()]
        assert len(refused) == ASKED - 1 - MAX_WAITING
        for task in refused:
            with pytest.raises(RefusedError, match="a report is being made and 4 are waiting"):
                task.result()
        assert children.started == 1
        (tmp_path / "go").touch()
        done = [await task for task in wanted if task not in refused]
        assert done == ["done\n"] * (1 + MAX_WAITING)
        assert await reports.make(tmp_path / "a.mcap") == "done\n", "then there is room again"

    asyncio.run(main())


def test_a_requester_that_leaves_ends_the_work_or_leaves_the_queue(tmp_path: Path) -> None:
    children = Children(tmp_path)

    async def main() -> None:
        reports = Reports(children.command)
        first, second = (asyncio.create_task(reports.make(tmp_path / "a.mcap")) for _ in range(2))
        await children.running(1)
        second.cancel()
        first.cancel()
        await asyncio.gather(first, second, return_exceptions=True)
        assert not children.pids()
        assert children.started == 1
        (tmp_path / "go").touch()
        assert await reports.make(tmp_path / "a.mcap") == "done\n"

    asyncio.run(main())


def test_a_report_that_takes_too_long_or_fails_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    children = Children(tmp_path)

    async def main() -> None:
        monkeypatch.setattr("skyloop.cockpit.recordings.REPORT_S", 0.05)
        with pytest.raises(LinkError, match=r"took longer than 0\.05 s"):
            await Reports(children.command).make(tmp_path / "a.mcap")
        assert not children.pids()
        monkeypatch.setattr("skyloop.cockpit.recordings.REPORT_S", 10.0)
        for said, told in (("echo no good >&2; exit 3", "no good"), ("true", "no report of a.mcap")):
            with pytest.raises(UsageError, match=told):
                await Reports(lambda *_, said=said: ["sh", "-c", said]).make(tmp_path / "a.mcap")

    asyncio.run(main())


@pytest.mark.process
def test_a_page_that_is_closed_ends_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over HTTP: the page requests a report, the connection ends, and so does the child."""
    children = Children(tmp_path)
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "a.mcap").touch()
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setattr("skyloop.cockpit.recordings.child_command", children.command)
    with served(recordings=folder) as address:
        line = http.client.HTTPConnection(address.removeprefix("http://"), timeout=5)
        line.request("GET", "/api/recordings/a.mcap/report")
        asyncio.run(children.running(1))
        line.close()
        asyncio.run(children.running(0))


@pytest.mark.process
def test_a_report_ends_with_the_process_that_requested_it(tmp_path: Path) -> None:
    fifo = tmp_path / "never.mcap"
    os.mkfifo(fifo)  # opening it blocks forever
    command = [sys.executable, "-m", "skyloop.cockpit.recordings", "report", str(fifo), str(tmp_path / "report.html")]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as child:
        assert child.stdin is not None
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(1.0)
        child.stdin.close()  # as the kernel does for a parent that is killed
        assert child.wait(10) == 1


def test_recordings_and_replays_are_few(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Replay:
        numbers = iter(range(100))

        def __init__(self, _: Path, drone: str | None) -> None:
            self.name = f"replay {next(self.numbers)}"

        def close(self) -> None: ...

    (tmp_path / "a.mcap").touch()
    made: list[Any] = []

    def start(drones: Sequence[str], folder: Path) -> FakeRecorder:
        time.sleep(0.001)
        made.append(FakeRecorder(drones, folder))
        return made[-1]  # type: ignore[no-any-return]

    async def main() -> None:
        recordings = Recordings(tmp_path, start, Replay)  # type: ignore[arg-type]
        wanted = [recordings.start(["alpha"]) for _ in range(ASKED)] + [
            recordings.replay("a.mcap") for _ in range(ASKED)
        ]
        outcomes = await asyncio.gather(*wanted, return_exceptions=True)
        refused = [outcome for outcome in outcomes if isinstance(outcome, RefusedError)]
        assert len(refused) == 2 * (ASKED - MAX_CHILDREN)
        assert {str(error).partition(":")[2] for error in refused} == {" stop one first", " end one first"}
        assert len(made) == len(recordings.replays) == MAX_CHILDREN
        await recordings.close()

    asyncio.run(main())


def test_many_simultaneous_requests_for_the_list_cost_as_much_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []

    def look(path: Path) -> Any:
        looked.append(path.name)
        return describe(path)

    monkeypatch.setattr(recordings_module, "describe", look)
    (tmp_path / "a.mcap").touch()

    async def main() -> None:
        recordings = Recordings(tmp_path)
        await asyncio.gather(*(recordings.listing() for _ in range(ASKED)))

    asyncio.run(main())
    assert looked == ["a.mcap"]


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_a_link_on_another_site_starts_nothing(site: str) -> None:
    """It has no origin: a browser says where the link was. ``same-site`` includes other ports of this machine."""
    told = [(b"host", b"127.0.0.1:8123"), (b"sec-fetch-site", site.encode())]
    for path in ("/api/recordings/a.mcap/report", "/api/recordings", "/api/drones", "/static/page.js"):
        assert "other pages" in foreign("http", "GET", told, NAMES, path)
    assert foreign("websocket", "GET", told, NAMES, "/ws/overview")
    assert foreign("http", "GET", told, NAMES, "/") == "", "a link to the page itself is allowed"
    for own in (b"same-origin", b"none"):
        told = [(b"host", b"127.0.0.1:8123"), (b"sec-fetch-site", own)]
        assert foreign("http", "GET", told, NAMES, "/api/recordings/a.mcap/report") == ""
    both = [*told, (b"sec-fetch-site", site.encode())]
    assert foreign("http", "GET", both, NAMES, "/api/recordings")
