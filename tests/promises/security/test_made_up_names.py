"""Names that an application invents (of topics, cameras, processors) are refused, and cost nothing permanent."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import msgspec
import pytest

from skyloop.client.connection import Scheduler
from skyloop.client.frame import FeedbackHistory
from skyloop.client.results import MAX_CHANNELS, MAX_WORKERS, Result, ResultChannels, ResultMailbox
from skyloop.messages import (
    Annotation,
    Done,
    EventKind,
    JoinProcessor,
    ProcessorResult,
    Refusal,
    Refused,
    Role,
    encode,
)
from skyloop.messages.relayed import pack
from skyloop.network.frames import MAX_FORMS, MAX_FORMS_EACH, FramePublisher
from skyloop.proxy.requests import MAX_MALFORMED
from skyloop.proxy.topics import FIXED_TOPICS, topic_problem
from skyloop.transport.base import ANNOTATIONS, MAX_SUBSCRIPTIONS, RESULTS
from skyloop.transport.testing import header, picture, wait_until
from tests.support.proxy_bench import WAIT_S, App, Bench

CAMERAS = ("front", "bottom")


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as bench:
        yield bench


@pytest.mark.parametrize(
    "topic",
    [
        *sorted(FIXED_TOPICS),
        "results/detector-1.b",
        "video/front",
        "stream/bottom",
        "video/front?encoding=jpeg&quality=80",
    ],
)
def test_existing_topics_can_be_subscribed_to(topic: str) -> None:
    assert topic_problem(topic, lambda: CAMERAS) == ""


@pytest.mark.parametrize(
    ("topic", "words"),
    [
        ("video/made-up", "no camera of this vehicle named 'made-up'; known: bottom, front"),
        ("stream/frnt", "did you mean 'front'"),
        ("video/", "not a topic of a camera"),
        ("video/front?scale=2", "scale is 2.0 and must be"),
        ("video/front?max_fps=1e-300", "max_fps"),
        ("results/" + "x" * 65, "1 to 64 letters"),
        ("results/a b", "1 to 64 letters"),
        ("evnts", "did you mean 'events'"),
        (
            "x" * 200,
            "annotations, commands, events, feedback, logs, overview, results, stream/bottom, stream/front, video/",
        ),
    ],
)
def test_an_unknown_name_is_refused_with_the_known_ones(topic: str, words: str) -> None:
    assert words in topic_problem(topic, lambda: CAMERAS)


def test_requests_for_made_up_cameras_are_answered_counted_and_finally_disconnected(bench: Bench) -> None:
    eye, bad = bench.join("eye"), bench.join("bad", Role.OBSERVER)
    bad.end.subscribe("video/made-up")
    bad.sync()
    (told,) = eye.told(EventKind.PACKET_MALFORMED)
    assert "malformed packet of bad: no camera of this vehicle named 'made-up'; known: front" in told.text
    assert bench.server.subscribers("video/made-up") == 0
    for number in range(MAX_MALFORMED + 1):
        bad.end.subscribe(f"video/made-up-{number}")
    assert "malformed packets within a second" in bad.closed_by.get(timeout=WAIT_S)
    eye.sync()


def test_the_number_of_topics_of_a_connection_is_bounded(bench: Bench) -> None:
    eye, bad = bench.join("eye"), bench.join("bad", Role.OBSERVER)
    for number in range(MAX_SUBSCRIPTIONS):
        bad.end.subscribe(f"results/detector-{number}")
    bad.sync()
    told = eye.told(EventKind.PACKET_MALFORMED)
    assert f"exceeds the {MAX_SUBSCRIPTIONS} topics" in told[0].text


def test_a_drawing_on_a_missing_camera_reaches_no_one(bench: Bench) -> None:
    eye, bad = bench.join("eye"), bench.join("bad", Role.OBSERVER)
    eye.end.subscribe(ANNOTATIONS)
    for camera in ("made-up", "front"):
        assert bad.end.send(encode(Annotation("me", camera, 1, 4, 3)))
    bad.sync()
    eye.sync()
    assert [one.camera for one in eye.others if isinstance(one, Annotation)] == ["front"]
    assert "no camera of this vehicle named 'made-up'" in eye.told(EventKind.PACKET_MALFORMED)[0].text


def detection(camera: str, captured_ns: int) -> ProcessorResult:
    return ProcessorResult("detector", camera, 5, captured_ns, captured_ns, 50, captured_ns, pack(1))


def test_a_worker_sends_results_of_its_camera_and_of_frames_that_were_captured(bench: Bench) -> None:
    eye, bad = bench.join("eye"), bench.join("bad", Role.OBSERVER)
    eye.end.subscribe(RESULTS)
    refused = bad.ask(JoinProcessor("detector", "code", "made-up"))
    assert isinstance(refused, Refused)
    assert (refused.code, "known: front" in refused.message) == (Refusal.UNSUPPORTED, True)
    assert bad.ask(JoinProcessor("detector", "code", "front")) == Done()
    now_ns = bench.clock()
    for one in (detection("made-up", now_ns), detection("front", now_ns + 10**10), detection("front", now_ns)):
        assert bad.end.send(encode(one))
    bad.sync()
    eye.sync()
    came = [one for one in eye.others if isinstance(one, ProcessorResult)]
    assert [(one.camera, one.captured_ns) for one in came] == [("front", now_ns)]
    (told, *_) = [event for event in eye.told(EventKind.PROCESSOR) if event.data["state"] == "refused"]
    assert "on frames of front, not of made-up" in told.text


# Frames over the network ----------------------------------------------------------------------------------------


class Readers:
    """A transport server's video; counts what it sends."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.video = FramePublisher(lambda variant, *_: self.sent.append(variant.request.topic), "alpha")
        self.video.topic_problem = lambda topic: topic_problem(topic, lambda: CAMERAS)

    @property
    def threads(self) -> int:
        return sum(thread.name == "skyloop-alpha-video" for thread in threading.enumerate())


@pytest.fixture
def readers() -> Iterator[Readers]:
    made = Readers()
    yield made
    made.video.end()


def test_made_up_cameras_over_the_network_make_no_threads(readers: Readers) -> None:
    for connection in range(20):
        for number in range(MAX_SUBSCRIPTIONS):
            assert not readers.video.subscribe(connection, f"video/made-up-{number}")
    assert readers.threads == 0
    assert "known: bottom, front" in readers.video.problem(1, "video/made-up")


def test_resources_for_a_reader_end_with_it(readers: Readers) -> None:
    for round_ in range(3):
        for connection in range(5):
            for camera in CAMERAS:
                assert readers.video.subscribe(connection, f"video/{camera}")
        assert readers.threads == 2
        readers.video.publish(header(round_ + 1), picture(header(round_ + 1)))
        wait_until(lambda: len(readers.sent) == round_ + 1, "it is served each time")  # noqa: B023
        for connection in range(5):
            readers.video.leave(connection)
        wait_until(lambda: readers.threads == 0, "its threads ended")
    assert readers.video._variants == {}


def test_the_forms_of_frames_are_bounded_but_the_usual_ones_always_available(readers: Readers) -> None:
    forms = [f"video/front?scale=0.{number:03}" for number in range(100, 200)]
    assert sum(readers.video.subscribe(0, form) for form in forms) == MAX_FORMS_EACH
    assert f"at most {MAX_FORMS_EACH} formats" in readers.video.problem(0, forms[-1])
    taken = sum(readers.video.subscribe(number, form) for number, form in enumerate(forms))
    assert taken <= MAX_FORMS
    assert f"at most {MAX_FORMS} formats" in readers.video.problem("new", forms[-1])
    assert readers.video.subscribe("new", forms[1]), "an existing one costs nothing more"
    for usual in ("video/front", "video/front?encoding=jpeg&quality=80"):
        assert readers.video.subscribe(0, usual)
        assert readers.video.subscribe("new", usual)
    for part in range(50):  # a group of workers, which together receive each frame once
        assert readers.video.subscribe(f"worker {part}", f"video/bottom?part={part}/50")


# A client's memory ---------------------------------------------------------------------------------------------


class Ears:
    offset_ns = 0

    def subscribe(self, topic: str, on: bool = True) -> None: ...
    def check_open(self) -> None: ...


def test_a_client_forgets_processors_that_are_not_requested_here() -> None:
    channels = ResultChannels(Ears(), Scheduler(), FeedbackHistory())  # type: ignore[arg-type]
    channels.everything.add(lambda _: None, lambda: 0)
    channels.channel("mine").keep()
    for number in range(3 * MAX_CHANNELS):
        channels.receive(msgspec.structs.replace(detection("front", 1), processor=f"made-up-{number}"), 1)
    assert len(channels.all()) <= MAX_CHANNELS
    for worker in range(2 * MAX_WORKERS):
        channels.receive(msgspec.structs.replace(detection("front", 1), processor="mine", worker=worker), 1)
    mine = channels.channel("mine")
    assert mine.counter.count == 2 * MAX_WORKERS
    assert len(mine._numbers) == MAX_WORKERS


def test_a_slot_for_all_results_forgets_the_oldest_processors() -> None:
    slot = ResultMailbox()
    for number in range(2 * MAX_CHANNELS):
        header_ = msgspec.structs.replace(detection("front", 1), processor=f"made-up-{number}")
        slot.put(Result(header_, 1, 0, FeedbackHistory(), lambda: 1))
    assert len(slot._mailboxes) == MAX_CHANNELS
    assert slot.dropped == MAX_CHANNELS


def test_a_good_application_is_not_affected(bench: Bench) -> None:
    app: App = bench.join("good")
    app.end.subscribe("video/front")
    app.end.subscribe("stream/front")
    app.end.subscribe("results/detector")
    assert app.told(EventKind.PACKET_MALFORMED) == []
