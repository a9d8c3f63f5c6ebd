"""Frames and their memory."""

from __future__ import annotations

import pickle
import sys
import traceback
from typing import Any

import numpy as np
import pytest

from skyloop.client.frame import FeedbackHistory, ReceivedFrame, to_bgr
from skyloop.client.session import frame_size
from skyloop.errors import DecodeError, MissingExtraError
from skyloop.messages import Encoding, Feedback, FrameHeader, Intrinsics

K = Intrinsics(10.0, 10.0, 4.0, 3.0)


def header(encoding: Encoding = Encoding.BGR8, width: int = 8, height: int = 6, size: int = 144) -> FrameHeader:
    return FrameHeader("front", 7, 1000, 2000, width, height, encoding, size, K)


def pixels(size: int = 144) -> np.ndarray[tuple[int], np.dtype[np.uint8]]:
    return (np.arange(size) % 251).astype(np.uint8)


def arrival(head: FrameHeader, data: np.ndarray[tuple[int], np.dtype[np.uint8]]) -> ReceivedFrame:
    return ReceivedFrame(head, data, 3000, 500, FeedbackHistory(), clock=lambda: 4500)


def test_a_frame_is_the_received_memory_and_knows_its_origin() -> None:
    data = pixels()
    frame = arrival(header(), data).frame()
    assert isinstance(frame, np.ndarray)
    assert frame.shape == (6, 8, 3)
    assert frame.dtype == np.uint8
    assert np.shares_memory(frame, data)
    assert not frame.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        frame[0, 0, 0] = 1
    assert (frame.camera, frame.seq, frame.captured_ns, frame.published_ns, frame.received_ns) == (
        "front",
        7,
        1000,
        2000,
        3000,
    )
    assert frame.intrinsics is K
    assert frame.header.encoding is Encoding.BGR8
    assert frame.age_s == pytest.approx((4500 + 500 - 1000) / 1e9)
    plain = np.asarray(frame)
    assert type(plain) is np.ndarray
    assert np.shares_memory(plain, frame)
    assert not plain.flags.writeable
    assert frame.feedback is None
    assert frame.feedback_reach_s is None


def test_a_frame_shows_itself_in_a_notebook() -> None:
    cv2 = pytest.importorskip("cv2")
    frame: Any = arrival(header(), pixels()).frame()
    for image in (frame, frame[1:4, ::2], frame[:, :, 0], frame.T[0]):
        encoded = image._repr_png_()
        assert encoded is not None
        shown = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(shown, np.asarray(image))
    assert frame[0, 0]._repr_png_() is None, "a pixel is not a picture"
    assert frame[:0]._repr_png_() is None


def test_derived_arrays_are_plain() -> None:
    frame = arrival(header(), pixels()).frame()
    own = frame.copy()
    own[0, 0] = (1, 2, 3)
    assert type(own) is np.ndarray
    assert type(frame + 1) is np.ndarray
    assert type(frame.mean(axis=0)) is np.ndarray
    assert isinstance(frame.mean(), float)
    assert type(frame == frame) is np.ndarray
    others: list[Any] = [frame[1:], frame.reshape(-1), pickle.loads(pickle.dumps(frame))]
    for derived in others:
        with pytest.raises(AttributeError, match="derived from a frame and has no captured_ns"):
            _ = derived.captured_ns
        with pytest.raises(AttributeError):
            _ = derived.feedback
    with pytest.raises(AttributeError, match="no attribute 'colour'"):
        _ = frame.colour
    with pytest.raises(AttributeError, match="no image: it is the image itself, a NumPy array") as raised:
        _ = frame.image
    assert "imag'" not in "".join(traceback.format_exception(raised.value))


def test_consumers_share_one_frame() -> None:
    shared = arrival(header(), pixels())
    first = shared.frame()
    assert shared.frame() is first


def test_rgb_and_mono_become_bgr() -> None:
    rgb = to_bgr(header(Encoding.RGB8), pixels())
    assert np.array_equal(rgb, pixels().reshape(6, 8, 3)[:, :, ::-1])
    assert rgb.flags.c_contiguous
    mono = to_bgr(header(Encoding.MONO8, size=48), pixels(48))
    assert mono.shape == (6, 8, 3)
    assert np.array_equal(mono[:, :, 0], pixels(48).reshape(6, 8))
    assert np.array_equal(mono[:, :, 0], mono[:, :, 2])


def test_jpeg_is_decoded_once() -> None:
    cv2 = pytest.importorskip("cv2")
    picture = np.full((24, 32, 3), (200, 100, 50), np.uint8)
    _, data = cv2.imencode(".jpg", picture)
    flat = data.reshape(-1)
    one = arrival(header(Encoding.JPEG, 32, 24, flat.size), flat)
    frame = one.frame()
    assert np.abs(frame.astype(int) - picture).max() < 8
    image = frame.base
    del frame
    assert one.frame().base is image, "decoded again"


@pytest.mark.parametrize("data", [b"\xff\xd8no picture", b"\xff", b"\0" * 100])
def test_a_broken_jpeg(data: bytes) -> None:
    pytest.importorskip("cv2")
    broken = np.frombuffer(data, np.uint8)
    with pytest.raises(DecodeError, match="not a JPEG of 8 × 6"):
        arrival(header(Encoding.JPEG, size=broken.size), broken).frame()


def test_a_jpeg_of_another_size_than_announced_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it came to the decoder"))
    large = cv2.imencode(".jpg", np.zeros((600, 800, 3), np.uint8))[1]
    with pytest.raises(DecodeError, match="not a JPEG of 8 × 6"):
        arrival(header(Encoding.JPEG, size=large.size), large).frame()


def test_a_jpeg_without_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match="skyloop install vision"):
        arrival(header(Encoding.JPEG), pixels()).frame()


def test_a_jpeg_of_another_size_is_refused() -> None:
    cv2 = pytest.importorskip("cv2")
    _, data = cv2.imencode(".jpg", np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(DecodeError):
        arrival(header(Encoding.JPEG, size=data.size), data.reshape(-1)).frame()


def test_sizes_are_checked() -> None:
    assert frame_size(header(size=143)) == 144
    assert frame_size(header(Encoding.MONO8)) == 48
    assert frame_size(header(Encoding.JPEG, size=99)) == 99


def test_the_state_at_capture_improves_until_it_is_final() -> None:
    history = FeedbackHistory()
    frame = ReceivedFrame(header(), pixels(), 3000, 0, history).frame()
    history.add(Feedback(captured_ns=500, altitude_m=1.0))
    assert frame.feedback is not None
    assert (frame.feedback.altitude_m, frame.feedback_reach_s) == (1.0, 500 / 1e9)
    history.add(Feedback(captured_ns=2000, altitude_m=4.0))
    assert frame.feedback.altitude_m == pytest.approx(2.0)
    assert frame.feedback_reach_s == pytest.approx(1000 / 1e9)
    history.add(Feedback(captured_ns=100))  # the proxy restarted: this frame's state stays
    assert frame.feedback.altitude_m == pytest.approx(2.0)
