"""The content of a file, encoded and decoded: times, topics, metadata, samples, schemas."""

from __future__ import annotations

import json
import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import FileFormatError
from skyloop.messages import (
    Annotation,
    Applied,
    Capabilities,
    Feedback,
    FrameHeader,
    Parameter,
    ParameterType,
    Velocity,
)
from skyloop.recording.layout import (
    META_CLOCK,
    TYPES,
    Channel,
    ClockPair,
    DroneRecord,
    Drops,
    End,
    FrameRecord,
    ResultRecord,
    Start,
    Topic,
    decode,
    encode,
    from_metadata,
    image_topic,
    parse_topic,
    schema,
    schema_name,
    to_metadata,
    to_plain,
)
from tests.support.samples import CAMERA, SAMPLES, TILT

header = SAMPLES["frame"]
assert isinstance(header, FrameHeader)
ALL: dict[str, msgspec.Struct] = {
    **{name: sample for name, sample in SAMPLES.items() if type(sample) in TYPES.values()},
    "frame": FrameRecord(header, 17, "jpeg"),
    "result": ResultRecord("detector", 3, 4, "front", 12, 3_000_000_000, 3_040_000_000, 35_000_000, {"boxes": [[1.5]]}),
    "parameter": TILT,
    "parameter-vector": Parameter("gains", ParameterType.VECTOR, (1.0, 2.0), choices=((1.0, 2.0), (3.0, 4.0))),
    "parameter-text": Parameter("mode", ParameterType.TEXT, "free", default="home", choices=("free", "home")),
    "drops": Drops(5, {"video.front": 3}, {"feedback": 1}),
}


@pytest.mark.parametrize("name", ALL)
def test_samples_round_trip(name: str) -> None:
    data = encode(ALL[name])
    assert decode(data, type(ALL[name])) == ALL[name]
    assert isinstance(json.loads(data), dict)


def test_every_channel_has_a_sample_here() -> None:
    assert {type(sample) for sample in ALL.values()} == set(TYPES.values())


def test_keys_are_fields_and_unknown_values_are_absent() -> None:
    plain = json.loads(encode(Feedback(captured_ns=1, altitude_m=2.0)))
    assert plain["altitude_m"] == 2.0
    assert plain["failsafe"] == "none"
    assert "battery" not in plain
    applied = json.loads(encode(ALL["applied"]))
    assert applied["asked"] == {"action": "velocity", "forward": 9.0, "left": 0.0, "up": 0.0, "yaw_rate": 0.0}
    shapes = json.loads(encode(ALL["annotation"]))["shapes"]
    assert [shape["shape"] for shape in shapes] == ["polyline", "points", "text"]


@given(st.lists(st.floats(), min_size=4, max_size=4), st.dictionaries(st.text(max_size=5), st.floats(), max_size=3))
def test_numbers_that_are_not_finite_come_back_as_nan(numbers: list[float], native: dict[str, float]) -> None:
    applied = Applied(1, 1, 1, 1, 1, Velocity(*numbers), Velocity(0.0, 0.0, 0.0, 0.0))
    back = decode(encode(applied), Applied).asked
    assert isinstance(back, Velocity)
    for before, after in zip(numbers, msgspec.structs.astuple(back), strict=True):
        assert after == before if math.isfinite(before) else math.isnan(after)
    feedback = decode(encode(Feedback(captured_ns=1, velocity_m_s=(1.0, math.inf, 0.0), native=dict(native))), Feedback)
    assert feedback.velocity_m_s is None, "a vector with an unknown part is unknown"
    assert feedback.native is not None
    assert all(math.isnan(feedback.native[k]) or feedback.native[k] == v for k, v in native.items())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (b"{", Feedback),
        (b"\xff", Feedback),
        (b"[]", Feedback),
        (b"{}", Feedback),
        (b'{"captured_ns": "soon"}', Feedback),
        (b'{"captured_ns": 1, "state": "levitating"}', Feedback),
        (b'{"captured_ns": 1, "velocity_m_s": [1, 2]}', Feedback),
        (encode(ALL["applied"]).replace(b"velocity", b"teleport"), Applied),
        (encode(ALL["annotation"]).replace(b'"polyline"', b"7"), Annotation),
        (b"7", FrameRecord),
    ],
)
def test_invalid_samples_are_refused(data: bytes, kind: type[msgspec.Struct]) -> None:
    with pytest.raises(FileFormatError):
        decode(data, kind)


def test_fields_of_a_later_version_are_ignored() -> None:
    assert decode(b'{"captured_ns": 3, "colour": "red"}', Feedback) == Feedback(captured_ns=3)


# Schemas -------------------------------------------------------------------------------------------------------

#: The only keywords known to the JSON readers of Foxglove and Lichtblick.
SIMPLE = {"boolean", "string", "number", "integer"}


def check_viewers_schema(described: dict[str, Any]) -> None:
    assert described["type"] == "object"
    for field in described["properties"].values():
        kind = field["type"]
        if kind == "object":
            check_viewers_schema(field)
        elif kind == "array":
            if field["items"]["type"] not in SIMPLE:
                check_viewers_schema(field["items"])
        else:
            assert kind in SIMPLE


def check_value(value: Any, described: dict[str, Any]) -> None:
    """Check a JSON value against its schema; null stands for a number."""
    kinds: dict[str, Any] = {
        "boolean": bool,
        "string": str,
        "number": int | float,
        "integer": int,
        "array": list,
        "object": dict,
    }
    if value is None:
        return
    assert isinstance(value, kinds[described["type"]])
    if described["type"] == "object":
        for name, item in described["properties"].items():
            if name in value:
                check_value(value[name], item)
    elif described["type"] == "array":
        for item in value:
            check_value(item, described["items"])


@pytest.mark.parametrize("name", ALL)
def test_samples_match_their_schema_and_viewers_understand_it(name: str) -> None:
    described = json.loads(schema(type(ALL[name])))
    check_viewers_schema(described)
    check_value(json.loads(encode(ALL[name])), described)
    assert described["title"] == schema_name(type(ALL[name]))


def test_plotted_fields_are_in_the_schemas() -> None:
    def properties(kind: type[msgspec.Struct]) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(schema(kind))["properties"]
        return found

    assert {"roll_rad", "altitude_m", "battery", "velocity_m_s", "native"} <= set(properties(Feedback))
    assert {"forward", "roll", "action"} <= set(properties(Applied)["asked"]["properties"])
    assert properties(TYPES[Channel.LOGS])["number"] == {"type": "number"}


# Times, topics, metadata ---------------------------------------------------------------------------------------


def test_times_are_mapped_by_one_pair() -> None:
    pair = ClockPair(monotonic_ns=1_000, unix_ns=50_000, pid=1)
    assert pair.unix(1_500) == 50_500
    assert pair.unix(901_500, offset_ns=900_000) == 50_500  # the proxy's clock is ahead
    assert pair.monotonic(pair.unix(123_456, 7), 7) == 123_456
    assert pair.unix(-(10**12)) == 0
    now = ClockPair.now()
    assert from_metadata(to_metadata(now), ClockPair) == now


@given(st.text(min_size=1, max_size=20), st.text(min_size=1, max_size=20))
def test_topics_round_trip(drone: str, camera: str) -> None:
    for channel in Channel:
        topic = Topic(drone, channel, camera if channel is Channel.FRAMES else "")
        assert parse_topic(str(topic)) == topic
        assert str(topic).startswith("/")
    assert parse_topic(image_topic(drone, camera)) is None


@pytest.mark.parametrize(
    "other", ["/log", "/tf", "/alpha/pose", "/alpha/frames", "/alpha/feedback/x", "alpha/feedback", ""]
)
def test_other_topics_are_not_ours(other: str) -> None:
    assert parse_topic(other) is None


def test_metadata_round_trips() -> None:
    able = Capabilities("sim", frozenset({"land", "takeoff"}), (CAMERA,), "a drone")
    start = Start(1, "0.2", (DroneRecord("alpha", "sim://", to_plain(able), -5),), 10, 2, {"quality": 90})
    texts = to_metadata(start)
    assert all(isinstance(text, str) for text in texts.values())
    assert texts["skyloop"] == "0.2"
    back = from_metadata(texts, Start)
    assert back == start
    assert back.drones[0].described == able
    end = End("closed", 20, {"/alpha/feedback": 3}, {"alpha": {"video.front": 1}}, {})
    assert from_metadata(to_metadata(end), End) == end


@pytest.mark.parametrize("texts", [{}, {"monotonic_ns": "x"}, {"monotonic_ns": '"1"', "unix_ns": "1", "pid": "1"}])
def test_bad_metadata(texts: dict[str, str]) -> None:
    with pytest.raises(FileFormatError, match="ClockPair"):
        from_metadata(texts, ClockPair)
    assert META_CLOCK == "skyloop.clock"
