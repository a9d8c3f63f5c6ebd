"""Following a target marked on a page: a real proxy, an obedient vehicle, and a stand-in for the follower."""

from __future__ import annotations

import gc
import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skyloop.client import Drone, Frame
from skyloop.cockpit import follow_session
from skyloop.cockpit.commands import decode_command
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.follow_session import NO_CONTROL
from skyloop.errors import DecodeError, MissingExtraError
from skyloop.messages import Annotation, FlightState, Hover, Velocity
from skyloop.processing import Settings, Worker
from tests.cockpit.follower import StandIn, StandIns
from tests.support.cockpit import Node, Nodes, cockpit, until
from tests.support.cockpit_page import BOX, FORWARD, Marker, Page, count, page
from tests.support.testclient import TestClient

#: All that a cockpit has imported, then the real follower with detections; it prints what that imports besides.
FIRST_TARGET = """
import sys
import skyloop.cockpit.app
import skyloop.cockpit.target_tracker as tracker
from skyloop.clock import nanoseconds
from skyloop.vision import Detection
from tests.support.shown_target import flown, follower_of, the_box
from tests.support.target_world import PERIOD_S
assert "scipy" not in sys.modules, "the test would show nothing"
tracker.warm_up()
known = set(sys.modules)
follower = follower_of(class_name="person")
flown(follower, 0.3)
follower.detected([Detection(the_box(), 0.9, 0, "person")], nanoseconds(1.0 + 3 * PERIOD_S))
flown(follower, 0.3, start=1.4)
assert follower.sighting.box is not None
print(sorted(set(sys.modules) - known))
"""


@pytest.fixture
def stand_ins() -> StandIns:
    return StandIns()


@pytest.fixture
def client(node: Node, stand_ins: StandIns) -> Iterator[TestClient]:
    with cockpit(CockpitFleet(Nodes(node), search_s=0.05), follower=stand_ins) as client:
        yield client


@contextmanager
def marker(client: TestClient) -> Iterator[Marker]:
    with page(client) as pilot:
        yield Marker(pilot)


def refused(pilot: Page, do: str) -> str:
    return str(pilot.wait("refused", do=do)["why"])


def draws(watcher: Drone, frames: int) -> None:
    """Wait this many frames, as a person would."""
    for _ in itertools.islice(watcher.frames("front"), frames):
        pass


def test_a_marked_target_is_tracked_then_followed_until_stopped(
    client: TestClient, node: Node, stand_ins: StandIns
) -> None:
    drawn: list[Annotation] = []
    with marker(client) as pilot, node.connect("watcher", access="observe") as watcher:
        watcher.on_annotation(drawn.append)
        pilot.mark()
        told = pilot.wait("follow", state="tracking", phase="")
        assert told["box"] == BOX
        assert told["size"] == [32, 24]
        assert (told["confidence"], told["range_m"], told["speed_m_s"]) == (0.9, 4.0, None)
        assert told["mode"] is None
        one = stand_ins.last
        assert one.frames[0] == pilot.since_ns, "it begins on the frame that the box was drawn on"
        assert one.samples[0].captured_ns <= one.frames[0], "and knows the vehicle's motion from then on"
        until(lambda: drawn)
        assert (drawn[0].source, drawn[0].captured_ns) == ("follow", pilot.since_ns)
        pilot.say("follow_mode", mode="follow")
        assert refused(pilot, "follow_mode") == "take control first"
        pilot.take().say("follow_mode", mode="follow")
        assert "take off first" in refused(pilot, "follow_mode")
        pilot.take_off()
        assert not count(node, FORWARD)
        with pilot.staying():
            pilot.say("follow_mode", mode="orbit", distance_m=6.0)
            assert pilot.wait("follow", state="flying")["mode"] == "orbit"
            until(lambda: count(node, FORWARD) > 3 and node.flyer.state is FlightState.FLYING)
            assert (one.mode, one.settings.distance_m) == ("orbit", 6.0)
            pilot.say("follow_mode", mode="look")
            until(lambda: one.mode == "look")
            one.says(phase="lost", lost_s=1.5, box=None, problem="hidden")
            told = pilot.wait("follow", phase="lost")
            assert (told["state"], told["box"], told["lost_s"], told["problem"]) == ("flying", None, 1.5, "hidden")
            pilot.say("follow_stop")
            assert pilot.wait("follow", state="ended")["problem"] == ""
            until(lambda: node.flyer.applied[-1] == Hover())
        assert one.threads == {"skyloop-follow"}, "it is called from one thread"
    until(lambda: not any(thread.name == "skyloop-follow" for thread in threading.enumerate()))


def test_a_box_with_a_mode_is_followed_at_once(client: TestClient, node: Node, stand_ins: StandIns) -> None:
    with marker(client) as pilot:
        pilot.take()
        pilot.mark(mode="follow")
        assert "take off first" in refused(pilot, "follow")
        pilot.take_off()
        with pilot.staying():
            pilot.mark(mode="follow", class_name="person", distance_m=3.0)
            pilot.wait("follow", state="flying")
            until(lambda: count(node, FORWARD))
            assert (stand_ins.last.class_name, stand_ins.last.settings.distance_m) == ("person", 3.0)
            pilot.mark(mode="look", box=[1, 1, 8, 8])
            assert pilot.wait("follow", state="ended")["problem"] == "another target was marked"
            until(lambda: Hover() in node.flyer.applied)
            pilot.wait("follow", state="flying")
            assert stand_ins.last.box == (1, 1, 8, 8)


def test_it_catches_up_frame_by_frame_before_it_steers(client: TestClient, node: Node, stand_ins: StandIns) -> None:
    with marker(client) as pilot, node.connect("watcher", access="observe") as watcher:
        pilot.take().take_off()
        pilot.select()
        with pilot.staying():
            draws(watcher, frames=40)
            pilot.say("follow", camera="front", captured_ns=str(pilot.since_ns), box=BOX, mode="follow")
            pilot.wait("follow", state="flying")
            frames = list(stand_ins.last.frames)
            assert len(frames) > 8
            steps = [after - before for before, after in itertools.pairwise(frames)]
            assert min(steps) > 0
            assert sorted(steps)[len(steps) // 2] <= 90_000_000, "in steps of at most 70 ms, unless frames are missing"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"camera": "rear"}, "no camera named 'rear'; known: front"),
        ({"box": [4, 4, 2, 12]}, "width=2, height=12 and must be at least 6 pixels"),
        ({"box": [40, 4, 10, 12]}, "at least half of it must be in the image of 32×24"),
        ({"captured_ns": "17"}, "s old when its box arrived"),
        ({"captured_ns": "9" * 18}, "newer than any"),
        ({"mode": "chase"}, "no mode of following named 'chase'"),
        ({"mode": "follow"}, "take control first"),
        ({"distance_m": -1.0}, "distance_m is -1.0 and must be above 0"),
        ({"distance_m": 0.5}, "distance_m is 0.5 and must be above nearest_m, which is 2"),
    ],
)
def test_invalid_targets_are_refused_with_the_allowed_values(
    client: TestClient, stand_ins: StandIns, values: dict[str, Any], words: str
) -> None:
    with marker(client) as pilot:
        pilot.mark(**values)
        assert words in refused(pilot, "follow")
        assert not stand_ins.made
        pilot.say("follow_mode", mode="follow")
        assert refused(pilot, "follow_mode") == "take control first"


@pytest.mark.parametrize(
    "text",
    [
        '{"do":"follow"}',
        '{"do":"follow","camera":"front","captured_ns":5,"box":[1,2,3,4]}',
        '{"do":"follow","camera":"front","captured_ns":"-5","box":[1,2,3,4]}',
        '{"do":"follow","camera":"front","captured_ns":"5","box":[1,2,3]}',
        '{"do":"follow","camera":"front","captured_ns":"5","box":[1,2,NaN,4]}',
        '{"do":"follow","camera":"front","captured_ns":"5","box":[1,2,"3",4]}',
        '{"do":"follow","camera":"","captured_ns":"5","box":[1,2,3,4]}',
        '{"do":"follow_mode"}',
        '{"do":"follow_mode","mode":7}',
        '{"do":"follow_select"}',
    ],
)
def test_nonsense_is_not_a_follow_command(text: str) -> None:
    with pytest.raises(DecodeError, match="not understood"):
        decode_command(text)


def test_without_frames_or_a_target_there_is_nothing_to_follow(client: TestClient) -> None:
    with marker(client) as pilot:
        pilot.say("follow", camera="front", captured_ns="5", box=BOX)
        assert "select the camera first" in refused(pilot, "follow")
        pilot.say("follow_select", camera="rear")
        assert "no camera named 'rear'" in refused(pilot, "follow_select")
        pilot.take().say("follow_mode", mode="follow")
        assert "mark one first" in refused(pilot, "follow_mode")
        pilot.say("follow_stop", n=3)
        pilot.wait("sent", do="follow_stop", n=3)
        pilot.select()
        pilot.say("follow_select", camera=None, n=4)
        pilot.wait("sent", n=4)
        pilot.say("follow", camera="front", captured_ns=str(pilot.since_ns), box=BOX)
        assert "select the camera first" in refused(pilot, "follow")


def test_without_opencv_the_refusal_names_the_extra(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(what: str) -> None:
        raise MissingExtraError(what, "vision")

    monkeypatch.setattr(follow_session, "opencv", missing)
    with marker(client) as pilot:
        pilot.say("follow_select", camera="front")
        assert "skyloop install vision" in refused(pilot, "follow_select")


@contextmanager
def following(client: TestClient, node: Node) -> Iterator[Marker]:
    with marker(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.mark(mode="follow")
            pilot.wait("follow", state="flying")
            until(lambda: node.flyer.state is FlightState.FLYING)
            yield pilot


def test_a_consensual_handover_causes_no_refusal(client: TestClient, node: Node, stand_ins: StandIns) -> None:
    """The giver, while following a target, got the news of a lost control, and of idle refused for its lease."""
    with following(client, node) as giver, page(client) as asker:
        with giver.staying():
            giver.select()  # a box for the next target is being drawn
        asker.say("take", priority=8, ask=True)
        [asked] = giver.wait("asked")["questions"]
        giver.say("answer", id=asked["id"], grant=True)
        told = giver.wait("authority", mine=False)
        assert told["given"]
        if told["holder"] is None:  # for a moment no one has it
            told = giver.wait("authority", holder=asked["by"])
        assert told["why"] == f"{asked['by']} has control now"
        giver.say("ping", n=6)
        giver.wait("pong", n=6)
        assert [one["problem"] for one in giver.told if one.get("state") == "ended"] == [NO_CONTROL]
        assert asker.wait("authority", mine=True)["holder"] == asked["by"]
        until(lambda: node.flyer.state is FlightState.HOVERING, "it hovers before it changes hands")
        with asker.staying():
            asker.say("fly", up=0.1)
            until(lambda: count(node, Velocity(up=0.1)))
            giver.say("ping", n=7)
            giver.wait("pong", n=7)
            asker.say("hover")
            asker.wait("done", do="hover")
        for pilot in (giver, asker):
            assert [one for one in pilot.told if one["type"] == "refused"] == []


@pytest.mark.parametrize(
    ("do", "values", "then"),
    [
        ("hover", {}, FlightState.HOVERING),
        ("land", {}, FlightState.LANDED),
        ("fly", {"up": 0.1}, FlightState.FLYING),
        ("goto", {"x": 5.0, "y": 0.0, "z": 1.0}, FlightState.FLYING),
        ("release", {}, FlightState.HOVERING),
        ("stop", {}, FlightState.EMERGENCY),
    ],
)
def test_any_other_command_ends_following(
    client: TestClient, node: Node, do: str, values: dict[str, Any], then: FlightState
) -> None:
    with following(client, node) as pilot:
        pilot.say(do, **values)
        assert pilot.wait("follow", state="ended")["problem"]
        until(lambda: node.flyer.state is then)
        flown = count(node, FORWARD)
        pilot.say("ping", n=9)
        pilot.wait("pong", n=9)
        assert count(node, FORWARD) == flown, "nothing more comes from what was followed"


def test_a_takeover_ends_following(client: TestClient, node: Node) -> None:
    with following(client, node) as pilot, node.connect("other", priority=0) as other:
        assert pilot.wait("follow", state="ended")["problem"] == NO_CONTROL
        other.hover()
        until(lambda: node.flyer.state is FlightState.HOVERING)


def test_a_silent_page_hovers(client: TestClient, node: Node) -> None:
    with marker(client) as pilot:
        pilot.take().take_off()
        pilot.mark(mode="follow")
        pilot.wait("follow", state="flying")
        assert "the page was silent" in pilot.wait("follow", state="ended")["problem"]
        until(lambda: node.flyer.applied[-1] == Hover())


def test_a_page_that_is_gone_hovers(client: TestClient, node: Node) -> None:
    with following(client, node):
        pass
    until(lambda: node.flyer.state is not FlightState.FLYING)
    until(lambda: not any(thread.name == "skyloop-follow" for thread in threading.enumerate()))


def test_it_hovers_without_frames_and_resumes_with_them(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    with following(client, node) as pilot:
        flows = threading.Event()
        frame = node.flyer._sink.frame  # type: ignore[union-attr]
        monkeypatch.setattr(node.flyer._sink, "frame", lambda *a, **k: flows.is_set() and frame(*a, **k))
        told = pilot.wait("follow", state="waiting")
        assert "no new frame of front for 0." in told["problem"]
        until(lambda: node.flyer.state is FlightState.HOVERING)
        flows.set()
        pilot.wait("follow", state="flying")
        until(lambda: node.flyer.state is FlightState.FLYING)


def test_it_hovers_while_the_motion_is_unknown_and_resumes_afterwards(
    client: TestClient, node: Node, stand_ins: StandIns
) -> None:
    """Instead of a hover it was sent level attitudes, or zero velocities that it could not measure."""
    with following(client, node) as pilot:
        stand_ins.last.says(unknown="the vehicle's velocity is not known")
        told = pilot.wait("follow", state="waiting")
        assert told["problem"] == "the vehicle's velocity is not known: it hovers until that is known"
        until(lambda: node.flyer.state is FlightState.HOVERING)
        stand_ins.last.says(unknown="")
        pilot.wait("follow", state="flying")
        until(lambda: node.flyer.state is FlightState.FLYING)


def test_a_tracker_that_is_stuck_flies_nothing(client: TestClient, node: Node, stand_ins: StandIns) -> None:
    with following(client, node) as pilot:
        stand_ins.last.waits = threading.Event()
        pilot.wait("follow", state="waiting")
        until(lambda: node.flyer.state is FlightState.HOVERING)
        stand_ins.last.waits.set()
        pilot.wait("follow", state="flying")


def test_an_old_request_does_not_start_following(
    client: TestClient, node: Node, stand_ins: StandIns, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skyloop.cockpit.follow_session.SET_OFF_S", 0.2)
    with marker(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.mark()
            pilot.wait("follow", state="tracking", phase="")
            stand_ins.last.waits = threading.Event()
            pilot.say("follow_mode", mode="follow")
            pilot.wait("follow", mode="follow")
            time.sleep(0.3)
            stand_ins.last.waits.set()
            assert "mark the target again" in pilot.wait("follow", state="ended")["problem"]
            assert not count(node, FORWARD)


def test_it_ends_hovering_when_it_gives_up_or_fails(client: TestClient, node: Node, stand_ins: StandIns) -> None:
    with following(client, node) as pilot:
        stand_ins.last.says(problem="lost for too long")
        stand_ins.last.over = True
        until(lambda: pilot.wait("follow", state="ended")["problem"] == "lost for too long")
        until(lambda: node.flyer.applied[-1] == Hover())

        def hostile(one: StandIn) -> None:
            one.fails = RuntimeError("no such thing")

        stand_ins.prepare = hostile
        pilot.mark(mode="follow")
        assert pilot.wait("follow", state="ended")["problem"] == "tracking failed: RuntimeError: no such thing"
        stand_ins.prepare = lambda _: None
        pilot.mark(class_name="unicorn")
        assert "there are no unicorns" in pilot.wait("follow", state="ended")["problem"]


def test_detections_of_processors_are_used(client: TestClient, node: Node, stand_ins: StandIns) -> None:
    class Finds:
        def process(self, frame: Frame) -> dict[str, Any]:
            one = {"box": [1.0, 2.0, 8.0, 9.0], "score": 0.8, "class_id": 0, "class_name": "person"}
            return {"detections": [one, {"box": "?"}]}

    with marker(client) as pilot, node.connect("finds", access="observe") as drone:
        pilot.mark()
        pilot.wait("follow", state="tracking", phase="")
        worker = Worker(drone, Finds(), Settings("detections", "Finds 1"))
        worker.run(seconds=0.3)
        until(lambda: stand_ins.last.detections)
        (found, captured_ns) = stand_ins.last.detections[0]
        assert [(one.class_name, one.box) for one in found] == [("person", (1.0, 2.0, 8.0, 9.0))]
        assert captured_ns > pilot.since_ns


@pytest.mark.process
def test_marking_a_first_target_imports_nothing() -> None:
    """SciPy was, with 400 modules: for a second or more the cockpit processed no sticks."""
    pytest.importorskip("scipy", reason="needs the extra detect: skyloop install detect")
    command = [sys.executable, "-c", FIRST_TARGET]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_a_command_that_the_proxy_refuses_ends_it(client: TestClient, node: Node, stand_ins: StandIns) -> None:
    with following(client, node) as pilot:
        node.flyer.state = FlightState.LANDING  # commanded by others
        assert "it is landing" in pilot.wait("follow", state="ended")["problem"]
        assert stand_ins.last.frames


def test_numbers_are_sent_at_most_five_times_a_second(client: TestClient, node: Node) -> None:
    with following(client, node) as pilot:
        began_s = time.monotonic()
        for _ in range(5):
            pilot.wait("follow", state="flying")
        assert time.monotonic() - began_s > 0.75


def test_kept_frames_do_not_hold_the_proxys_memory(client: TestClient, node: Node) -> None:
    """Frames are kept as JPEGs: the proxy has its memory back."""
    with marker(client) as pilot, node.connect("watcher", access="observe") as watcher:
        pilot.select()
        draws(watcher, frames=30)
        gc.collect()
        assert sum(isinstance(one, Frame) for one in gc.get_objects()) < 10
