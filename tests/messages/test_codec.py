"""The codec, with golden, truncated, invalid and random packets."""

from __future__ import annotations

import math
import random
import time
import tracemalloc
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.messages import (
    AnyReply,
    Attitude,
    AuthorityGranted,
    AuthorityQueued,
    Command,
    EncodedFrame,
    Event,
    EventKind,
    Intrinsics,
    Kind,
    Position,
    Reply,
    Request,
    RequestAuthority,
    ReturnPhase,
    ReturnToStart,
    Sample,
    Velocity,
    Welcome,
    decode,
    encode,
)
from skyloop.messages.codec import HEADER, HEADER_SIZE, KINDS, MAX_BODY, SIGNATURE, VERSION
from skyloop.messages.fields import LATEST_NS
from skyloop.messages.frame import MAX_PIECE
from tests.support.samples import CAMERA, PACKETS, SAMPLES

LONGEST_DECODE_S = 1.0


def packet(kind: int, body: bytes, *, length: int | None = None) -> bytes:
    return HEADER.pack(SIGNATURE, VERSION, kind, 0, len(body) if length is None else length) + body


@pytest.mark.parametrize("name", SAMPLES)
def test_golden_packets_decode_to_their_samples_and_back(name: str) -> None:
    golden = (PACKETS / "golden" / f"{name}.bin").read_bytes()
    assert decode(golden) == SAMPLES[name]
    assert encode(decode(golden)) == golden


def test_a_camera_of_an_older_proxy_has_no_stream() -> None:
    older = decode((PACKETS / "older" / "reply-welcome.bin").read_bytes())
    assert isinstance(older, Reply)
    assert isinstance(older.body, Welcome)
    (camera,) = older.body.capabilities.cameras
    assert camera == msgspec.structs.replace(CAMERA, stream="")


@pytest.mark.parametrize("name", ["feedback", "feedback-minimal"])
def test_feedback_of_an_older_proxy_has_no_link_reason_and_no_other_controller(name: str) -> None:
    older = decode((PACKETS / "older" / f"{name}.bin").read_bytes())
    before: dict[str, object] = {"link_reason": "", "link_remedy": "", "others": None}
    before |= {"start_position_m": None, "return_phase": ReturnPhase.NONE, "skipped": 0, "outcome": None}
    before |= {"next_owner": None}
    assert older == msgspec.structs.replace(SAMPLES[name], **before)


def test_a_command_of_an_older_client_counts_as_its_applications_request() -> None:
    older = decode((PACKETS / "older" / "command-hover.bin").read_bytes())
    assert older == SAMPLES["command-hover"]
    assert isinstance(older, Command)
    assert not older.automatic


@pytest.mark.parametrize("name", ["reply-value", "reply-page"])
def test_an_older_proxy_marks_no_parameter_as_momentary(name: str) -> None:
    assert decode((PACKETS / "older" / f"{name}.bin").read_bytes()) == SAMPLES[name]


def test_an_older_proxy_does_not_report_its_clock() -> None:
    older = decode((PACKETS / "older" / "reply-welcome-without-clock.bin").read_bytes())
    newer = SAMPLES["reply-welcome"]
    assert isinstance(newer, Reply)
    assert older == without_software(msgspec.structs.replace(newer.body, clock=""))


def test_an_older_proxy_does_not_report_software_actions() -> None:
    newer = SAMPLES["reply-welcome"]
    assert isinstance(newer, Reply)
    assert isinstance(newer.body, Welcome)
    older = decode((PACKETS / "older" / "reply-welcome-without-software.bin").read_bytes())
    assert older == without_software(newer.body)


def without_software(welcome: AnyReply) -> Reply:
    assert isinstance(welcome, Welcome)
    capabilities = msgspec.structs.replace(welcome.capabilities, software=frozenset())
    return Reply(1, msgspec.structs.replace(welcome, capabilities=capabilities))


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (Position(1e5 + 1, 0.0, 0.0), "x is 100001 m and must be within 100000 m"),
        (Position(0.0, -1e9, 0.0), "y is -1e"),
        (Position(0.0, 0.0, 1e6), "z is 1e"),
        (Position(0.0, 0.0, 1.0, yaw=1e4), "yaw is 10000 rad and must be from -1000 to 1000"),
        (Position(0.0, 0.0, 1.0, speed=0.0), "speed is 0 m/s and must be more than 0"),
        (ReturnToStart(-0.5), "height is -0.5 m above the start and must be from 0 to 100000 m"),
        (Position(0.0, 0.0, 1.0, turn_rate=-1.0), "turn_rate is -1 rad/s and must be more than 0"),
    ],
)
def test_nonsensical_actions_report_a_problem(action: Position, words: str) -> None:
    assert action.finite
    assert words in action.problem
    assert not Position(1.0, 2.0, 3.0, -7.0, 0.1, 0.1).problem
    assert not Velocity(1e9).problem


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("request-authority", Request(2, RequestAuthority(3, False))),
        ("reply-granted", Reply(2, AuthorityGranted(7))),
        ("reply-queued", Reply(2, AuthorityQueued(1, "alice", 0))),
    ],
)
def test_authority_messages_of_older_ends(name: str, known: Sample) -> None:
    assert decode((PACKETS / "older" / f"{name}.bin").read_bytes()) == known


@pytest.mark.parametrize("for_s", [0.0, -1.0, 86_401.0, math.nan, math.inf])
def test_an_invalid_time_is_refused(for_s: float) -> None:
    with pytest.raises(DecodeError, match=r"86400|Expected"):
        decode(encode(Request(1, RequestAuthority(for_s=for_s))))


def test_the_largest_piece_of_a_picture_fits_a_packet() -> None:
    camera = "\N{GRINNING FACE}" * 64
    last = 2**63 - 1
    intrinsics = Intrinsics(0.1, 0.1, 0.1, 0.1, (0.1,) * 14, "fisheye")
    picture = EncodedFrame(
        camera, last, LATEST_NS, LATEST_NS, 16384, 16384, "h264", True, bytes(MAX_PIECE), intrinsics, camera * 3, 62, 63
    )
    assert decode(encode(picture)) == picture


def test_there_is_a_golden_packet_of_every_kind_action_request_and_reply() -> None:
    assert {type(sample) for sample in SAMPLES.values()} == set(KINDS)
    assert {path.stem for path in (PACKETS / "golden").glob("*.bin")} == set(SAMPLES)


@pytest.mark.parametrize("path", sorted((PACKETS / "invalid").glob("*.bin")), ids=lambda p: p.stem)
def test_invalid_packets_are_refused_with_the_reason_in_their_name(path: Path) -> None:
    expected = (path.with_suffix(".txt")).read_text().strip()
    with pytest.raises(DecodeError, match=expected):
        decode(path.read_bytes())


@pytest.mark.parametrize("name", SAMPLES)
def test_every_truncation_is_refused(name: str) -> None:
    whole = encode(SAMPLES[name])
    for length in range(len(whole)):
        with pytest.raises(DecodeError):
            decode(whole[:length])
        if length >= HEADER_SIZE:  # also with a header that matches the shorter body
            shorter = packet(whole[5], whole[HEADER_SIZE:length])
            with pytest.raises(DecodeError):
                decode(shorter)


@given(st.binary(max_size=300))
def test_random_bytes_give_a_sample_or_a_decode_error(data: bytes) -> None:
    try:
        decode(data)
    except DecodeError:
        return
    raise AssertionError("12 random bytes cannot be a header")


@given(st.sampled_from(list(Kind)), st.binary(max_size=300))
def test_random_bodies_give_a_sample_or_a_decode_error(kind: Kind, body: bytes) -> None:
    try:
        sample = decode(packet(kind, body))
    except DecodeError:
        return
    assert KINDS[type(sample)] == kind


@given(st.sampled_from(sorted(SAMPLES)), st.data())
def test_flipped_bits_give_a_sample_or_a_decode_error(name: str, data: st.DataObject) -> None:
    damaged = bytearray(encode(SAMPLES[name]))
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    try:
        decode(bytes(damaged))
    except DecodeError:
        return


HOSTILE = {
    "array of 2^32 elements": b"\xdd\xff\xff\xff\xff",
    "map of 2^32 elements in native": b"\x9d\x01" + b"\xc0" * 11 + b"\xdf\xff\xff\xff\xff",
    "string of 2^32 bytes": b"\x92\x01\xdb\xff\xff\xff\xff",
    "60000 nested arrays": b"\x91" * MAX_BODY,
    "60000 nested arrays in a skipped field": b"\x9f\x01" + b"\xc0" * 20 + b"\x91" * (MAX_BODY - 30),
    "60000 nested maps": b"\x81\xa1a" * (MAX_BODY // 3),
}


@pytest.mark.parametrize("body", HOSTILE.values(), ids=HOSTILE)
@pytest.mark.parametrize("kind", list(Kind))
def test_hostile_bodies_are_refused_in_bounded_time_and_memory(kind: Kind, body: bytes) -> None:
    tracemalloc.start()
    begin = time.perf_counter()
    try:
        with pytest.raises(DecodeError):
            decode(packet(kind, body))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert time.perf_counter() - begin < LONGEST_DECODE_S
    assert peak < 20 * MAX_BODY


def test_ten_thousand_random_packets_are_all_refused() -> None:
    source = random.Random(1)
    refused = 0
    for _ in range(10_000):
        try:
            decode(source.randbytes(source.randrange(200)))
        except DecodeError:
            refused += 1
    assert refused == 10_000


def test_fields_of_a_later_version_are_skipped_and_defaults_fill_missing_ones() -> None:
    body = msgspec.msgpack.encode([1, 7, 3, 99, [7, 0.5], False, "a later field", {"more": [1, 2]}])
    assert decode(packet(Kind.COMMAND, body)) == Command(1, 7, 3, 99, Velocity(forward=0.5))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_non_finite_actions_decode_and_are_marked(number: float) -> None:
    for action in (Attitude(climb=number), Velocity(up=number), Position(0.0, number, 0.0), Position(0, 0, 0, number)):
        sample = decode(encode(Command(1, 1, 1, 1, action)))
        assert isinstance(sample, Command)
        assert not sample.action.finite


def test_two_infinities_of_opposite_signs_are_not_finite() -> None:
    assert not Velocity(math.inf, -math.inf).finite
    assert Velocity(1e300, -1e300).finite


def test_a_sample_too_large_for_a_packet_is_refused_when_encoding() -> None:
    event: Sample = Event(EventKind.VEHICLE_MESSAGE, "x" * (MAX_BODY + 1), 1)
    with pytest.raises(ValueError, match="Event is 600"):
        encode(event)
