"""Workers in this process: the frames that they take, their results, and errors of the user's class."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skyloop.client import Drone, Frame, Result
from skyloop.client.drone import open_drone
from skyloop.errors import NameTakenError, UsageError
from skyloop.messages import Annotation, LogEntry, Polyline, Severity
from skyloop.processing import Output, Settings, Worker
from tests.support.fake_vehicle import WAIT_S, Node, node
from tests.support.scripted_proxy import QUICK
from tests.support.systems import STEP_NS, only_on

__all__ = ["node"]  # a fixture


@contextmanager
def observer(node: Node, app: str) -> Iterator[Drone]:
    with open_drone(node.server.dial, app=app, access="observe", policy=QUICK) as drone:
        yield drone


@pytest.fixture
def eye(node: Node) -> Iterator[Drone]:
    with observer(node, "eye") as drone:
        yield drone


class Does:
    """A processor that is a function."""

    def __init__(self, function: Callable[[Frame], Any]) -> None:
        self.process = function


@contextmanager
def working(
    node: Node,
    function: Callable[[Frame], Any],
    app: str = "worker",
    tell: Callable[[str], None] = print,
    **fields: Any,
) -> Iterator[Worker]:
    """Run a worker with its own connection and thread."""
    with observer(node, app) as drone:
        worker = Worker(drone, Does(function), Settings(**{"name": "detector", "code": "Does 1", **fields}), tell)
        thread = threading.Thread(target=worker.run)
        thread.start()
        try:
            yield worker
        finally:
            worker.stop()
            thread.join(WAIT_S)


@contextmanager
def collected(node: Node, eye: Drone) -> Iterator[list[Result]]:
    """Collect all results as they arrive."""
    got: list[Result] = []
    with eye.on_result(got.append, inline=True):
        eye.wait(lambda _: node.server.subscribers("results") == 1, WAIT_S)
        yield got


def test_results_carry_the_capture_of_their_frame(node: Node, eye: Drone) -> None:
    def process(frame: Frame) -> dict[str, Any]:
        return {"value": int(frame[0, 0, 0]), "captured_ns": frame.captured_ns, "corner": frame[:1, :1].copy()}

    with collected(node, eye) as got, working(node, process) as worker:
        eye.wait(lambda _: len(got) >= 5 and worker.status.results >= 5, WAIT_S)
        assert worker.status.age_s is not None
        assert "part 1 of 1" in str(worker.status)
    for result in got:
        assert result.value["captured_ns"] == result.captured_ns
        assert result.value["corner"].shape == (1, 1, 3)
        assert result.made_ns + STEP_NS > result.captured_ns
    assert (
        len({(result.value["value"] - result.seq) % 256 for result in got}) == 1
    )  # the vehicle draws its count of frames
    assert [result.seq for result in got] == sorted({result.seq for result in got})


def test_workers_share_the_frames(node: Node, eye: Drone) -> None:
    def process(frame: Frame) -> int:
        return frame.seq

    with collected(node, eye) as got, working(node, process, "one") as one, working(node, process, "two") as two:
        eye.wait(lambda _: one.status.parts == two.status.parts == 2, WAIT_S)
        begin = len(got)
        eye.wait(lambda _: len(got) >= begin + 20, WAIT_S)
    later = got[begin + 2 :]
    counted = Counter(result.seq for result in later)
    assert set(counted.values()) == {1}
    assert {(result.worker, result.seq % 2) for result in later} == {
        (worker, part) for part, worker in enumerate(sorted({result.worker for result in later}))
    }


def test_all_workers_get_all_frames_if_not_shared(node: Node, eye: Drone) -> None:
    def process(frame: Frame) -> int:
        return frame.seq

    with collected(node, eye) as got, working(node, process, "one", shared=False) as one:
        with working(node, process, "two", shared=False) as two:
            eye.wait(lambda _: min(one.status.results, two.status.results) > 20, WAIT_S)
            assert (one.status.parts, two.status.parts, one.status.workers) == (1, 1, 2)
        workers = Counter(result.worker for result in got)
    assert len(workers) == 2
    seqs = [{result.seq for result in got if result.worker == worker} for worker in workers]
    assert len(seqs[0] & seqs[1]) >= 10


def test_a_hanging_worker_gives_its_share_to_the_others_until_it_is_back(node: Node, eye: Drone) -> None:
    hang, go_on = threading.Event(), threading.Event()

    def sometimes(frame: Frame) -> int:
        if hang.is_set():
            go_on.wait(WAIT_S)
        return frame.seq

    with (
        collected(node, eye) as got,
        working(node, sometimes, "one", stuck_s=0.1) as one,
        working(node, lambda frame: frame.seq, "two") as two,
    ):
        eye.wait(lambda _: one.status.parts == two.status.parts == 2, WAIT_S)
        hang.set()
        eye.wait(lambda _: (one.status.parts, two.status.parts) == (0, 1), WAIT_S)
        begin = len(got)
        eye.wait(lambda _: len(got) >= begin + 6, WAIT_S)
        alone = [result.seq for result in got[begin + 1 :]]
        assert {seq % 2 for seq in alone} == {0, 1}
        hang.clear()
        go_on.set()
        eye.wait(lambda _: one.status.parts == two.status.parts == 2, WAIT_S)
        states = [str(event.data["state"]) for event in eye.recent_events() if event.kind.value == "processor"]
        assert states == ["joined", "joined", "busy", "back"]


def test_exceptions_of_process_are_reported_and_work_continues(node: Node, eye: Drone) -> None:
    told: list[str] = []
    logged: list[LogEntry] = []

    def process(frame: Frame) -> int:
        if frame.seq % 2:
            raise ValueError("no good")
        return frame.seq

    with collected(node, eye) as got, eye.on_log(logged.append):
        eye.wait(lambda _: node.server.subscribers("logs") == 1, WAIT_S)
        with working(node, process, tell=told.append) as worker:
            eye.wait(lambda _: worker.status.errors >= 3 and len(got) >= 3 and bool(logged), WAIT_S)
    assert len(told) < worker.status.errors  # at most once a second
    assert "detector failed (1 times so far):\nTraceback" in told[0]
    assert "ValueError: no good" in told[0]
    assert "in process\n    raise ValueError" in told[0]
    assert "worker.py" not in told[0].replace("test_worker.py", "")  # none of our own lines
    assert (logged[0].name, logged[0].severity) == ("detector", Severity.ERROR)
    assert logged[0].text is not None
    assert "ValueError: no good" in logged[0].text


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (lambda: 0, "a result can't be sent: it contains a builtins.function"),
        (np.zeros(100_000), "an array of 800000 bytes"),
        (Output(1, ["circle"]), "this can't be drawn on a frame"),  # type: ignore[list-item]
    ],
)
def test_unsendable_results_are_reported_once_and_counted(node: Node, eye: Drone, value: Any, words: str) -> None:
    told: list[str] = []
    with working(node, lambda frame: value, tell=told.append) as worker:
        eye.wait(lambda _: worker.status.refused >= 4, WAIT_S)
        assert worker.status.results == worker.status.errors == 0
    [text] = told
    assert words in text
    assert "Further ones are counted" in text


def test_shapes_are_drawn_and_none_publishes_no_result(node: Node, eye: Drone) -> None:
    drawn: list[Annotation] = []
    box = Polyline(((1.0, 1.0), (2.0, 2.0)))
    with collected(node, eye) as got, eye.on_annotation(drawn.append):
        eye.wait(lambda _: node.server.subscribers("annotations") == 1, WAIT_S)
        with working(node, lambda frame: Output(None if frame.seq % 2 else frame.seq, [box])):
            eye.wait(lambda _: len(got) >= 3 and len(drawn) >= 8, WAIT_S)
    assert {result.seq % 2 for result in got} == {0}
    assert drawn[0].source == "detector"
    assert drawn[0].shapes == (box,)


@only_on("linux", "darwin", reason="frames that are younger than a step of the clock are 0 s old")
def test_old_frames_are_skipped_and_counted(node: Node, eye: Drone) -> None:
    with working(node, lambda frame: frame.seq, max_age_s=0.0) as worker:
        eye.wait(lambda _: worker.status.stale >= 5, WAIT_S)
        assert worker.status.results == 0


def test_a_slow_worker_drops_frames_and_a_paced_one_too(node: Node, eye: Drone) -> None:
    entered, go_on = threading.Event(), threading.Event()

    def slow(frame: Frame) -> int:
        entered.set()
        go_on.wait(WAIT_S)
        return frame.seq

    with working(node, slow, stuck_s=WAIT_S) as worker:
        assert entered.wait(WAIT_S)
        eye.wait(lambda _: worker.status.dropped >= 3, WAIT_S)
        go_on.set()
    with collected(node, eye) as got, working(node, lambda frame: frame.seq, max_fps=10.0):
        eye.wait(lambda _: len(got) >= 6, WAIT_S)
    assert got[-1].made_ns - got[0].made_ns >= 0.25e9  # five periods, of which the first ones may have been short
    assert got[-1].seq - got[0].seq > 6


def test_it_ends_after_its_time_with_its_drone_and_when_its_name_is_taken(node: Node) -> None:
    with observer(node, "one") as drone:
        settings = Settings("detector", "Does 1")
        Worker(drone, Does(lambda frame: 0), settings).run(seconds=0.05)
        refused = Worker(drone, Does(lambda frame: 0), settings)
        refused.membership.refused = NameTakenError("somebody else")
        with pytest.raises(NameTakenError, match="somebody else"):
            refused.run()
        ending = Worker(drone, Does(lambda frame: 0), settings)
        thread = threading.Thread(target=ending.run)
        thread.start()
        drone.close()
        thread.join(WAIT_S)
        assert not thread.is_alive()


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"name": "a b"}, "name of a processor"),
        ({"max_age_s": -1.0}, "max_age_s is -1.0"),
        ({"max_fps": 0.0}, "max_fps is 0.0 and must be a number above 0"),
        ({"stuck_s": float("inf")}, "stuck_s is inf"),
    ],
)
def test_invalid_settings(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Settings(**{"name": "detector", "code": "", **fields})
