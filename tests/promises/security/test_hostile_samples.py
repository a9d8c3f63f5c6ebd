"""Samples with meaningless numbers, shapes and depths: refused at decoding, or harmless to all
receivers.

Each kind of sample is taken, and its values are replaced by those that a hostile program may send. Samples that pass
the codec go to its users: the cockpit's feeds and the recorder's translation.
"""

from __future__ import annotations

import math
import time
import tracemalloc
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.client import Drone
from skyloop.cockpit.feeds import WAYPOINTS, LogFeed, drawing_values
from skyloop.cockpit.telemetry import event_values, feedback_values, flat_values, mocap_values, motion_values
from skyloop.errors import DecodeError, UsageError
from skyloop.messages import (
    Annotation,
    Applied,
    CameraInfo,
    Capabilities,
    Event,
    Feedback,
    LogEntry,
    Parameter,
    Points,
    ProcessorResult,
    ProcessorShare,
    Reply,
    Sample,
    VideoRequest,
    decode,
    encode,
)
from skyloop.messages.codec import HEADER_SIZE, KINDS
from skyloop.messages.fields import LATEST_NS
from skyloop.messages.relayed import ARRAY, MAX_DEPTH, pack, unpack
from skyloop.messages.subscription import FrameFilter
from skyloop.recording.backlog import Item, Rank
from skyloop.recording.layout import ClockPair
from skyloop.recording.translation import Translator
from tests.support.samples import SAMPLES, log_entry, packet

LONGEST_S = 1.0
MOST_BYTES = 8_000_000
CLOCK = ClockPair(1_000_000_000, 1_800_000_000_000_000_000, 1)
ABLE = Capabilities("test", cameras=(CameraInfo("front", 320, 240, 30.0),))

HOSTILE = st.one_of(
    st.integers(-(2**63), 2**64 - 1),
    st.sampled_from([-1, 0, 2**31, 2**62, 2**63 - 1, 2**63, 2**64 - 1, -(2**63)]),
    st.floats(),
    st.sampled_from([math.nan, math.inf, -math.inf, 1.7e308, 5e-324]),
    st.none() | st.booleans() | st.text(max_size=4) | st.binary(max_size=4),
    st.sampled_from(["", "x" * 5000, "\0", "\x1b[2J", [], {}, [2**62, 3], [2**62, 0], [[]] * 300, [math.nan] * 9]),
    st.builds(lambda depth: nested(depth), st.integers(1, 400)),
)


def nested(depth: int) -> Any:
    value: Any = 0
    for _ in range(depth):
        value = [value]
    return value


def places(value: Any, path: tuple[int | str, ...] = ()) -> list[tuple[int | str, ...]]:
    """The path of each value in a body, at any depth."""
    inside = enumerate(value) if isinstance(value, list) else value.items() if isinstance(value, dict) else ()
    return [path, *(deeper for key, item in inside for deeper in places(item, (*path, key)))]


def put(value: Any, path: tuple[int | str, ...], hostile: Any) -> Any:
    if not path:
        return hostile
    changed = value.copy()
    changed[path[0]] = put(value[path[0]], path[1:], hostile)
    return changed


class Ears:
    """A stand-in for a drone that provides the callbacks of a feed."""

    def on_command(self, function: Any, *, inline: bool) -> Any: ...
    def on_log(self, function: Any, *, inline: bool) -> Any: ...


def consume(sample: Sample) -> None:
    """Do everything that is done with a sample without a check of its meaning."""
    if isinstance(sample, Feedback):
        feedback_values(sample, 0)
        motion_values(sample)
        flat_values(sample, {}, None)
    if isinstance(sample, Annotation):
        msgspec.json.encode(drawing_values(sample))
    if isinstance(sample, Event):
        msgspec.json.encode(event_values(1, sample, 0))
    if isinstance(sample, LogEntry):
        feed = LogFeed(cast(Drone, Ears()))
        feed._log(sample)
        feed.numbers(), feed.waypoints()
        mocap_values(feed.mocap())
    if isinstance(sample, Feedback | Applied | Event | Annotation | LogEntry | ProcessorResult):
        item = Item(0, "any", Rank.KEPT, CLOCK.monotonic_ns, sample, 1)
        for message in Translator("alpha", ABLE, CLOCK).messages(item):
            assert 0 <= message.log_ns < 2**64
            assert 0 <= message.publish_ns < 2**64
            assert 0 <= message.sequence < 2**32


EACH = (2**31, 2**62, 2**63 - 1, 2**64 - 1, -1, -(2**63), math.nan, math.inf, 1.7e308, [2**62, 3], nested(300), None)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_hostile_value_at_any_one_place_is_refused_or_harmless(name: str) -> None:
    sample = SAMPLES[name]
    body = msgspec.msgpack.decode(encode(sample)[HEADER_SIZE:])
    begin = time.perf_counter()
    for path in places(body):
        for hostile in EACH:
            try:
                came = decode(packet(KINDS[type(sample)], put(body, path, hostile)))
            except DecodeError:
                continue
            consume(came)
    assert time.perf_counter() - begin < 2 * LONGEST_S


@settings(max_examples=200)
@given(st.sampled_from(sorted(SAMPLES)), st.data())
def test_whatever_a_sample_holds_is_refused_or_harmless(name: str, data: st.DataObject) -> None:
    sample = SAMPLES[name]
    body = msgspec.msgpack.decode(encode(sample)[HEADER_SIZE:])
    for _ in range(data.draw(st.integers(1, 3))):
        body = put(body, data.draw(st.sampled_from(places(body))), data.draw(HOSTILE))
    begin = time.perf_counter()
    try:
        came = decode(packet(KINDS[type(sample)], body))
    except DecodeError:
        return
    consume(came)
    assert time.perf_counter() - begin < LONGEST_S


@given(st.recursive(st.binary(max_size=40), lambda inner: st.lists(inner, max_size=3)), st.integers(0, 900))
def test_whatever_a_result_holds_is_refused_or_harmless(value: Any, depth: int) -> None:
    for _ in range(depth):
        value = [value]
    consume_result(msgspec.msgpack.encode(value))


@given(st.binary(max_size=200))
def test_any_bytes_as_a_result_are_refused_or_harmless(payload: bytes) -> None:
    consume_result(payload)


@pytest.mark.parametrize("dtype", ["float64", "uint8"])
@pytest.mark.parametrize("shape", [[2**62, 0], [32768, 32768, 0], [0, 2**62], [1, -1], [2**63, 2**63], [0] * 9])
def test_an_array_of_no_elements_and_endless_shape_is_refused(shape: list[int], dtype: str) -> None:
    array = msgspec.msgpack.Ext(ARRAY, msgspec.msgpack.encode([dtype, shape, b""]))
    payload = msgspec.msgpack.encode(array)
    begin = time.perf_counter()
    with pytest.raises(DecodeError):
        unpack(payload)
    consume_result(payload)
    assert time.perf_counter() - begin < LONGEST_S


def consume_result(payload: bytes) -> None:
    tracemalloc.start()
    try:
        consume(ProcessorResult("detector", "front", 1, 1, 1, 1, 1, payload))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < MOST_BYTES


def test_values_may_be_nested_only_so_deep() -> None:
    deepest = nested(MAX_DEPTH)
    assert unpack(pack(deepest)) == deepest
    with pytest.raises(UsageError, match=f"more than {MAX_DEPTH} deep"):
        pack([deepest])
    with pytest.raises(DecodeError, match=f"more than {MAX_DEPTH} deep"):
        unpack(msgspec.msgpack.encode({"a": deepest}))
    with pytest.raises(UsageError, match="no axis longer"):
        pack(np.zeros((2**20, 0)))


SHAPES = [(2**62, 3), (2**62, 0), (0,), (2, 2), (), (1, 1, 1, 1, 1, 1, 1, 2)]


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_that_is_not_that_of_the_values_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DecodeError, match="3 values can't have the shape"):
        decode(log_entry(name=WAYPOINTS, values=[0.0] * 3, shape=shape))
    with pytest.raises(ValueError, match="can't have the shape"):
        LogEntry("me", WAYPOINTS, 1, values=(0.0,) * 3, shape=shape)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"text": "a", "number": 1.0},
        {"number": math.nan},
        {"number": math.inf},
        {"values": [math.nan], "shape": [1]},
        {"text": "a", "shape": [1]},
        {"values": [], "shape": [2**62, 0]},
        {"text": "a", "at_ns": 2**64 - 1},
        {"text": "a", "at_ns": LATEST_NS + 1},
        {"text": "a", "at_ns": -(2**63)},
        {"text": "x" * 4097},
    ],
)
def test_an_invalid_log_entry_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(DecodeError):
        decode(log_entry(**changes))


def test_an_invalid_drawing_is_refused() -> None:
    good = Annotation("me", "front", 1, 320, 240, (Points(((1.0, 2.0),), (1, 2, 255)),))
    assert decode(encode(good)) == good
    for shape in (Points(((math.nan, 1.0),)), Points(((1.0, 1.0),), (256, 0, 0)), Points(((1.0, 1.0),), (-1, 0, 0))):
        with pytest.raises(DecodeError):
            decode(encode(msgspec.structs.replace(good, shapes=(shape,))))
    with pytest.raises(DecodeError):
        decode(encode(msgspec.structs.replace(good, width=2**40)))


@pytest.mark.parametrize(("part", "parts"), [(1, 1), (1, 0), (3, 2), (0, 1025)])
def test_an_invalid_share_is_refused(part: int, parts: int) -> None:
    with pytest.raises((DecodeError, ValueError)):
        decode(packet(12, ["detector", "front", part, parts, 1]))
    if parts <= 1024:
        with pytest.raises(ValueError, match="must be below parts"):
            ProcessorShare("detector", "front", part, parts, 1)


@pytest.mark.parametrize("fps", ["5e-324", "1e-320", "nan", "inf", "-1", "0"])
def test_a_rate_of_frames_that_has_no_period_is_refused(fps: str) -> None:
    with pytest.raises(UsageError, match="max_fps"):
        FrameFilter(VideoRequest.parse(f"video/front?max_fps={fps}"))


@given(st.text(max_size=60))
def test_any_text_is_a_request_for_video_or_refused(text: str) -> None:
    try:
        request = VideoRequest.parse(f"video/front?{text}")
    except UsageError:
        return
    FrameFilter(request).wants(2**63 - 1, LATEST_NS)


def test_parameters_of_a_driver_travel_whatever_their_bounds_are() -> None:
    """They do not come from a peer, so NaN and infinity in them are shown unchanged."""
    reply = decode((Path(__file__).parents[2] / "data/packets/golden/reply-value.bin").read_bytes())
    assert isinstance(reply, Reply)
    parameter = Parameter("x", reply.body.parameter.type, math.inf, minimum=-math.inf)  # type: ignore[union-attr]
    sample = Reply(1, msgspec.structs.replace(reply.body, parameter=parameter))
    assert decode(encode(sample)) == sample
