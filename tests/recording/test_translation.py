"""Samples become messages: times on two clocks, calibration, paths, and the start of a new file."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from skyloop.messages import (
    CameraInfo,
    Capabilities,
    Encoding,
    Feedback,
    FrameHeader,
    Intrinsics,
    LogEntry,
    Parameter,
    ProcessorResult,
)
from skyloop.messages import ParameterType as Type
from skyloop.messages.relayed import pack
from skyloop.recording import layout
from skyloop.recording.backlog import Item, Rank
from skyloop.recording.layout import Channel, ClockPair, FrameRecord, ResultRecord
from skyloop.recording.translation import Message, Trail, TranslatedImage, Translator
from tests.support.samples import CAMERA

UNIX = 1_000_000_000_000_000_000
CLOCK = ClockPair(0, UNIX, 1)
AHEAD_NS = 5_000  #: the proxy's clock minus the recorder's


def translator(*cameras: CameraInfo) -> Translator:
    return Translator("alpha", Capabilities("test", cameras=cameras), CLOCK, lambda: AHEAD_NS)


def messages(of: Translator, sample: object, received_ns: int = 9_000) -> list[Message]:
    return list(of.messages(Item(0, "any", Rank.KEPT, received_ns, sample, 1)))


def topics(found: list[Message]) -> list[str]:
    return [message.topic for message in found]


def picture(seq: int, intrinsics: Intrinsics | None, width: int = 4) -> TranslatedImage:
    header = FrameHeader("front", seq, seq + AHEAD_NS, seq, width, 3, Encoding.JPEG, 7, intrinsics)
    return TranslatedImage(FrameRecord(header, seq, "jpeg"), b"picture")


def test_capture_is_on_the_proxys_clock_and_receiving_on_ours() -> None:
    (message,) = messages(translator(), Feedback(captured_ns=7_000, seq=3))
    assert (message.publish_ns, message.log_ns, message.sequence) == (UNIX + 2_000, UNIX + 9_000, 3)
    assert layout.decode(message.data, Feedback).captured_ns == 7_000


def test_logs_are_published_in_order_of_arrival_regardless_of_their_times() -> None:
    of = translator()
    later, sooner = LogEntry("me", "later", 9_000, text="a"), LogEntry("me", "sooner", 6_000, text="b")
    found = messages(of, later) + messages(of, sooner)
    assert [message.publish_ns for message in found] == [message.log_ns for message in found]
    assert [layout.decode(found[number].data, LogEntry).at_ns for number in (0, 2)] == [9_000, 6_000]


def test_numbers_beyond_32_bits_restart() -> None:
    (message,) = messages(translator(), Feedback(captured_ns=1, seq=2**32 + 5))
    assert message.sequence == 5


def test_a_frame_and_its_image_belong_together() -> None:
    record, image = messages(translator(), picture(2**32 + 1, None))
    assert (record.topic, image.topic) == ("/alpha/frames/front", "/alpha/camera/front/image")
    assert (record.log_ns, record.publish_ns, record.sequence) == (image.log_ns, image.publish_ns, 1)


def test_calibration_is_written_on_change_and_in_each_file() -> None:
    one, other = Intrinsics(1.0, 1.0, 2.0, 1.5), Intrinsics(2.0, 2.0, 2.0, 1.5)
    found = translator()
    calibration = "/alpha/camera/front/calibration"
    came = [
        calibration in topics(messages(found, picture(seq, now))) for seq, now in enumerate((one, one, other, None))
    ]
    assert came == [True, False, True, False]
    assert topics(list(found.prelude(1))) == [calibration]
    assert calibration in topics(messages(found, picture(9, other, width=8)))


def test_a_file_starts_with_parameters_cameras_and_their_mountings() -> None:
    found = translator(CAMERA, CameraInfo("bottom", 4, 3, 30.0))
    messages(found, Parameter("tilt", Type.FLOAT, 0.1))
    messages(found, Parameter("tilt", Type.FLOAT, 0.2))
    parameter, mounting, calibration = found.prelude(1)
    assert layout.decode(parameter.data, Parameter).value == 0.2
    assert (mounting.topic, calibration.topic) == (layout.TF, "/alpha/camera/front/calibration")


def test_logged_numbers_are_not_lines_for_people() -> None:
    number = LogEntry("me", "error", 7_000, number=0.5)
    assert topics(messages(translator(), number)) == ["/alpha/logs"]
    text = LogEntry("me", "mode", 7_000, text="searching")
    assert topics(messages(translator(), text)) == ["/alpha/logs", layout.LOG]


def test_results_are_json_whatever_they_contain() -> None:
    value = {"boxes": np.array([[1.5, math.nan]]), 7: [b"x", None], "seen": True}
    sample = ProcessorResult("detector", "front", 12, 7_000, 8_000, 500, 4, pack(value), 3)
    (message,) = messages(translator(), sample)
    assert (message.topic, message.publish_ns, message.sequence) == ("/alpha/results", UNIX + 2_000, 12)
    record = layout.decode(message.data, ResultRecord)
    assert record.value == {"boxes": [[1.5, None]], "7": ["eA==", None], "seen": True}
    assert (record.processor, record.worker, record.made_ns, record.took_ns) == ("detector", 3, 8_000, 500)
    (unknown,) = messages(translator(), msgspec.structs.replace(sample, payload=b"\xc1"))
    assert layout.decode(unknown.data, ResultRecord).value is None


def test_every_channel_of_our_own_can_be_translated() -> None:
    assert set(layout.TYPES) == set(Channel)


def test_the_path_is_written_once_a_second_and_only_with_positions() -> None:
    found = translator()
    counts = 0
    for tenth in range(30):
        state = Feedback(
            captured_ns=tenth * 100_000_000,
            roll_rad=0.0,
            pitch_rad=0.0,
            yaw_rad=0.0,
            position_m=(0.1 * tenth, 0.0, 1.0),
        )
        counts += "/alpha/path" in topics(messages(found, state))
    assert counts == 3
    blind = Feedback(captured_ns=10**10, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, altitude_m=1.0)
    assert topics(messages(found, blind)) == ["/alpha/feedback", "/alpha/pose", "/tf"]


def test_a_long_path_is_thinned_out_evenly() -> None:
    path = Trail()
    for place in range(10_000):
        path.add(place)
    assert len(path.places) <= 400
    steps = {after - before for before, after in zip(path.places, path.places[1:], strict=False)}
    assert len(steps) == 1
    assert path.places[0] == 0
    assert path.places[-1] > 9_900
