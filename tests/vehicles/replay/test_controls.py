"""Pause, seek and speed of a replay: with a manual clock, and through a proxy."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import IO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skyloop
from skyloop.client import Authority
from skyloop.client.drone import open_drone
from skyloop.clock import ManualClock, monotonic_ns, nanoseconds
from skyloop.cockpit.station import PilotConnection
from skyloop.drivers.recording_sink import RecordingSink, SeenFrame
from skyloop.drivers.registry import make_driver
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Feedback, LinkState
from skyloop.proxy.proxy import Proxy
from skyloop.recording.reader import Entry, Recording
from skyloop.recording.scan import Piece
from skyloop.transport.memory import MemoryServer
from skyloop.vehicles.replay.player import IDLE_S, PAUSED, POSITION, SPEED, Playback, Player
from skyloop.vehicles.replay.source import ReplaySource, Timeline
from tests.support.recorded_flights import BEGIN_NS, MS, WIDTH, Plan, feedback_at, write_flight

Action = Callable[[Playback], object]
END_S = 3.9  #: within 0.1 s of the end of the flight


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds with ten frames and fifty states a second. Don't change it."""
    return write_flight(tmp_path_factory.mktemp("flights") / "flight.mcap", Plan(seconds=4.0, lossy=False))


class Script:
    """A replay on this thread, without waiting: when the player waits, the clock jumps to the next due time."""

    def __init__(self, path: Path, *actions: tuple[float, Action], loop: bool = False, until_s: float = 60.0) -> None:
        recording = Recording.open(path)
        self.source = ReplaySource(recording, recording.drone())
        self.playback = Playback(self.source.seconds)
        self.sink = RecordingSink(keep=4096)
        self._clock = ManualClock(monotonic_ns() - nanoseconds(1000.0))  # a sink wants no times in the future
        self._begin_ns = self._clock.now_ns
        self._until_ns = self._begin_ns + nanoseconds(until_s)
        self._actions = [(self._begin_ns + nanoseconds(at_s), action) for at_s, action in actions]
        player = Player(self.source, self.sink, self.playback, loop=loop, clock=self._clock, wait=self._wait)
        player.run(())
        assert not self.sink.problems, self.sink.problems

    def _wait(self, timeout_s: float) -> None:
        due_ns = self._clock.now_ns + nanoseconds(timeout_s)
        if self._actions and self._actions[0][0] <= due_ns:
            at_ns, action = self._actions.pop(0)
            self._clock.now_ns = max(self._clock.now_ns, at_ns)
            action(self.playback)
        elif timeout_s >= IDLE_S or due_ns > self._until_ns:
            self.playback.stop()
        else:
            self._clock.now_ns = due_ns

    def at_s(self, captured_ns: int) -> float:
        """Return a time stamp as seconds since the script started."""
        return (captured_ns - self._begin_ns) / 1e9

    @property
    def held(self) -> list[Feedback]:
        """Return the feedback published while paused."""
        return [state for state in self.sink.feedbacks if (state.native or {})["replay.paused"]]

    def frame_of(self, state: Feedback) -> SeenFrame:
        (found,) = [frame for frame in self.sink.frames if frame.captured_ns == state.captured_ns]
        return found


def paused(playback: Playback) -> object:
    return playback.set(PAUSED, True)


def played(playback: Playback) -> object:
    return playback.set(PAUSED, False)


def to(position_s: float) -> Action:
    return lambda playback: playback.set(POSITION, position_s)


def at_speed(speed: float) -> Action:
    return lambda playback: playback.set(SPEED, speed)


def number_of(frame: SeenFrame) -> int:
    """Return a frame's number in the flight: its bright column moves by three pixels per frame."""
    column = int(np.argmax(frame.pixels[:, :, 2].mean(axis=0)))
    return next(number for number in range(1, 21) if (number * 3) % WIDTH in range(column - 1, column + 2))


def recorded_state(at_ms: int) -> Feedback:
    return feedback_at(Plan(seconds=4.0), at_ms, 1)


def test_a_paused_seek_shows_image_and_state_of_one_instant(flight: Path) -> None:
    script = Script(flight, (1.0, paused), (1.5, to(0.5)), (2.0, to(1.71)), (3.0, played))
    shown = {(state.native or {})["replay.position_s"]: state for state in script.held}
    assert [round(float(position), 2) for position in shown if not isinstance(position, str | bool | tuple)] == [
        1.0,
        0.5,
        1.71,
    ]
    for position_s, frame_ms in ((0.5, 405), (1.71, 1705)):
        state = shown[position_s]
        frame = script.frame_of(state)
        assert number_of(frame) == frame_ms // 100 + 1
        captured_ms = frame_ms - 30  # the state at that time: 20 ms apart, captured 4 ms before publishing
        nearest = min(range(0, 4000, 20), key=lambda at_ms: abs(at_ms - 4 - captured_ms))
        assert state.position_m == pytest.approx(recorded_state(nearest).position_m)
        assert (state.native or {})["replay.applied"] in ("takeoff", "velocity")


def test_a_take_off_before_the_recorded_one_says_where_to_begin(flight: Path) -> None:
    with (
        skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone,
        pytest.raises(skyloop.NoAnswerError, match=r"begin there, with \?start=SECONDS"),
    ):
        drone.takeoff(timeout_s=0.05)


def test_times_never_go_back_and_samples_are_fresh(flight: Path) -> None:
    script = Script(flight, (2.0, to(0.2)), (3.0, paused), (3.5, to(3.0)), (3.8, to(0.0)), (4.0, played))
    for captured in (
        [one.captured_ns for one in script.sink.feedbacks],
        [one.captured_ns for one in script.sink.frames],
    ):
        assert captured == sorted(captured)
        assert all(later - earlier < 300 * MS for earlier, later in pairwise(captured)), "no suspicious silence"
    jumps = [(state.native or {})["replay.jumps"] for state in script.sink.feedbacks]
    assert (jumps[0], jumps[-1]) == (0, 3)


def test_it_resumes_where_it_was_paused(flight: Path) -> None:
    script = Script(flight, (1.001, paused), (31.001, played))
    playing = [state for state in script.sink.feedbacks if not (state.native or {})["replay.paused"]]
    assert len(playing) == 200, "nothing is missing, and nothing is repeated"
    assert [state.position_m for state in playing] == [recorded_state(at).position_m for at in range(0, 4000, 20)]
    assert script.at_s(playing[-1].captured_ns) == pytest.approx(34.0, abs=0.1)
    assert len(script.held) == pytest.approx(150, abs=2)
    (position,) = {(state.native or {})["replay.position_s"] for state in script.held}
    assert position == pytest.approx(1.0, abs=0.001)


def test_speed_changes_at_once(flight: Path) -> None:
    script = Script(flight, (1.0, at_speed(4.0)), (1.5, at_speed(0.5)))
    assert script.at_s(script.sink.feedbacks[-1].captured_ns) == pytest.approx(1.5 + 1.0 / 0.5, abs=0.1)
    assert script.sink.feedback_count == 200
    assert (script.sink.feedbacks[-1].native or {})["replay.speed"] == 0.5


def test_a_viewer_can_seek_back_from_the_end(flight: Path) -> None:
    script = Script(flight, (10.0, to(END_S)), (20.0, played), (30.0, paused), (31.0, to(1.0)))
    assert [state for state, _ in script.sink.links] == [
        LinkState.UP,
        *(LinkState.CLOSED, LinkState.UP) * 3,
    ], "closed at each end; finally paused"
    assert (script.sink.feedbacks[-1].native or {})["replay.position_s"] == 1.0
    assert script.sink.feedback_count > 2 * 200, "played again from the start"


def test_a_loop_is_a_jump(flight: Path) -> None:
    script = Script(flight, loop=True, until_s=9.0)
    native = script.sink.feedbacks[-1].native or {}
    assert (native["replay.loops"], native["replay.jumps"]) == (2, 2)


def test_a_seek_reads_only_part_of_the_file(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(flight, until_s=0.0)
    parts = script.source._recording.found.pieces
    assert len(parts) > 8
    script.source.moment(BEGIN_NS + 2000 * MS)  # finds the start of each part
    read: list[int] = []
    real = Recording._piece

    def counted(self: Recording, file: IO[bytes], piece: Piece, wanted: Collection[str] | None) -> Iterator[Entry]:
        read.append(piece.offset)
        return real(self, file, piece, wanted)

    monkeypatch.setattr(Recording, "_piece", counted)
    moment = script.source.moment(BEGIN_NS + 2010 * MS)
    assert moment.state is not None
    assert moment.pictures["front"].header.captured_ns == BEGIN_NS + (2005 - 30) * MS
    assert len(read) < len(parts) / 2
    assert next(moment.following).at_ns > BEGIN_NS + 2010 * MS


@settings(max_examples=40)
@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 5.0),
            st.one_of(
                st.booleans().map(lambda value: lambda playback: playback.set(PAUSED, value)),
                st.floats(0.0, 3.0).map(to),
                st.floats(0.25, 8.0).map(at_speed),
            ),
        ),
        max_size=8,
    )
)
def test_with_any_writes_times_grow_and_positions_stay_in_the_recording(
    flight: Path, actions: list[tuple[float, Action]]
) -> None:
    script = Script(flight, *sorted(actions, key=lambda action: action[0]), until_s=8.0)
    for state in script.sink.feedbacks:
        assert 0.0 <= float((state.native or {})["replay.position_s"]) <= script.source.seconds  # type: ignore[arg-type]


@given(
    st.floats(0.01, 1000.0),
    st.integers(0, 10**15),
    st.integers(0, 10**15),
    st.integers(0, 10**12),
    st.floats(0.01, 1000.0),
)
def test_a_timeline_is_invertible(speed: float, begin: int, origin: int, passed: int, other: float) -> None:
    timeline = Timeline(speed, begin, origin)
    now_ns = origin + passed
    recorded_ns = timeline.recorded(now_ns)
    assert timeline.at(recorded_ns) == pytest.approx(now_ns, abs=1 + 1 / speed)
    timeline.set_speed(other, now_ns)
    assert timeline.at(recorded_ns) == now_ns, "a change of speed is no jump"


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (POSITION, -0.1, "from 0 to"),
        (POSITION, 4.2, "from 0 to"),
        (POSITION, float("nan"), "from 0 to"),
        (POSITION, True, "from 0 to"),
        (SPEED, 0.0, "from 0.01 to 1000"),
        (SPEED, "fast", "from 0.01 to 1000"),
        (PAUSED, 1, "true or false"),
    ],
)
def test_invalid_values_are_refused(name: str, value: skyloop.messages.Value, words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        Playback(4.0).set(name, value)
    with pytest.raises(UnknownNameError):
        Playback(4.0).set("replay.colour", 1.0)


def test_in_step_it_refuses_with_the_reason(flight: Path) -> None:
    with skyloop.connect(f"replay://{flight}?speed=max") as drone:
        with pytest.raises(ParameterError, match="in step with its application"):
            drone.config["replay.position_s"] = 1.0
        assert drone.config["replay.paused"] is False


# Through a proxy -----------------------------------------------------------------------------------------------------


@contextmanager
def served(flight: Path) -> Iterator[MemoryServer]:
    server = MemoryServer("flight")
    proxy = Proxy(make_driver(f"replay://{flight}?loop=1"), server, name="flight")
    proxy.start()
    try:
        yield server
    finally:
        proxy.end()


def test_a_viewer_moves_it_and_a_controller_continues(flight: Path) -> None:
    with (
        served(flight) as server,
        open_drone(server.dial, app="controller", authority=Authority(priority=0), on_exit="hover") as controller,
        open_drone(server.dial, app="page", access="observe") as watching,
        PilotConnection.open(server.dial, "page of a pilot", 5.0) as pilot,  # without authority
    ):
        assert controller.authority.state == "held"
        pilot.config["replay.paused"] = True
        pilot.config["replay.position_s"] = 3.0
        pilot.config["replay.position_s"] = 1.0
        assert pilot.config["replay.position_s"] == 1.0
        assert controller.authority.state == "held"
        newest = 0
        for _ in range(2):  # frames continue, each newer, also for late subscribers
            frame = watching.next_frame()
            assert frame.captured_ns > newest
            newest = frame.captured_ns
        while (state := watching.next_feedback()).native is None or state.native["replay.position_s"] != 1.0:
            pass
        assert controller.next_frame().captured_ns >= newest
        with pytest.raises(skyloop.errors.AuthorityError):
            watching.config["replay.paused"] = False
        kinds = [event.text for event in watching.recent_events() if "replay." in event.text]
        assert kinds == [], "moving it is no event: dragging the slider would fill the list"
