"""Requests for feedback, and their topics."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.messages import FeedbackRequest, VideoRequest
from skyloop.messages.subscription import EVERY_SAMPLE, FrameFilter, RateLimiter
from skyloop.transport.base import FEEDBACK, MAX_TOPIC

requests = st.builds(FeedbackRequest, st.none() | st.floats(0.001, 1000.0))


@pytest.mark.parametrize(
    ("request_", "topic"),
    [
        (FeedbackRequest(), FEEDBACK),
        (FeedbackRequest(5), "feedback?max_hz=5"),
        (FeedbackRequest(0.5), "feedback?max_hz=0.5"),
    ],
)
def test_a_request_as_a_topic(request_: FeedbackRequest, topic: str) -> None:
    assert request_.topic == topic
    assert FeedbackRequest.parse(topic) == request_


@given(requests)
def test_every_request_has_one_topic_that_fits(request_: FeedbackRequest) -> None:
    assert FeedbackRequest.parse(request_.topic) == request_
    assert len(request_.topic) <= MAX_TOPIC


@given(requests, requests)
def test_a_union_covers_both_requests_and_no_more(one: FeedbackRequest, other: FeedbackRequest) -> None:
    both = one.union(other)
    assert both == other.union(one)
    assert both.period_s == min(one.period_s, other.period_s)
    assert one.union(EVERY_SAMPLE) == EVERY_SAMPLE


@pytest.mark.parametrize("max_hz", [0.0, -1.0, math.nan, math.inf, 1001, 1e-300, True, "5"])
def test_an_invalid_rate(max_hz: Any) -> None:
    with pytest.raises(UsageError, match=r"max_hz is .* and must be from 0\.001 to 1000 samples a second"):
        FeedbackRequest(max_hz)


@pytest.mark.parametrize(
    "topic",
    [
        "feedback?",
        "feedback?max_hz=nan",
        "feedback?max_hz=0",
        "feedback?max_hz=5.0",
        "feedback?max_hz=5&fields=battery",
        "feedback?fields=position_m,battery",
        "feedback?fields=battery,battery",
        "feedback?fields=owner",
        "feedback?fields=",
        "feedback?max_hz=5&max_hz=5",
        "feedback?colour=red",
        "feedback?max_hz",
        "feedback?max_hz=1&max_hz=2&fields=none",
        "feedbacks",
        "feedback/x?max_hz=5",
    ],
)
def test_invalid_topics_are_refused(topic: str) -> None:
    with pytest.raises(UsageError, match=r"is not a request for feedback|must be written 'feedback\?max_hz=5'"):
        FeedbackRequest.parse(topic)


@given(st.floats(0.5, 50.0), st.floats(1.0, 100.0), st.integers(0, 2**32))
def test_a_rate_is_kept_on_average(max_hz: float, source_hz: float, begin_ns: int) -> None:
    limiter = RateLimiter(max_hz)
    times = [begin_ns + round(i * 1e9 / source_hz) for i in range(300)]
    kept = [at for at in times if limiter.in_time(at)]
    span_s = (kept[-1] - kept[0]) / 1e9
    assert len(kept) - 1 <= (span_s * max_hz) * 1.0 + 0.2  # the tolerance of one sample
    assert len(kept) == len(times) if source_hz <= max_hz else len(kept) >= 300 * min(1.0, max_hz / source_hz) / 2


def test_frames_and_feedback_are_thinned_alike() -> None:
    limiter, frames = RateLimiter(10), FrameFilter(VideoRequest("front", max_fps=10))
    times = [i * 31_250_000 for i in range(100)]
    assert [limiter.in_time(at) for at in times] == [frames.wants(i, at) for i, at in enumerate(times)]
