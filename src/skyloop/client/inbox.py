"""Newest feedback, newest frame and newest results of one drone, waited for together by one thread."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Self

from skyloop.client.delivery import Topic
from skyloop.client.frame import Arrival, Frame
from skyloop.client.reception import Reception, VideoChannel
from skyloop.client.results import Result, ResultSlot
from skyloop.client.slots import Buffer
from skyloop.messages import Feedback


class Inbox:
    """One slot for feedback, one for frames and one for the results of each processor, each with the newest, and one
    bell for all. A context manager."""

    def __init__(
        self,
        reception: Reception,
        *,
        feedback: bool,
        channel: VideoChannel | None,
        results: Sequence[Topic[Result]],
        slot: ResultSlot,
    ) -> None:
        """``feedback``: whether it is wanted; ``channel``: the camera whose frames are wanted; ``results``: topics
        that go into ``slot``."""
        self.clock = reception.pace.clock  #: on which a controller's time runs
        self.bell = slot.bell
        self._feedback: Buffer[Feedback] = Buffer(1, self.bell)
        self._frames: Buffer[Arrival] = Buffer(1, self.bell)
        self._results = slot
        self._reception = reception
        self._channel = channel
        self._topics = results
        self._wants_feedback = feedback
        self._put_feedback, self._put_frame, self._put_result = self._feedback.put, self._frames.put, slot.put

    def __enter__(self) -> Self:
        if self._wants_feedback:
            self._reception.on_feedback.add(self._put_feedback, lambda: self._feedback.dropped)
        if self._channel is not None:
            self._channel.topic.add(self._put_frame, lambda: self._frames.dropped)
        for topic in self._topics:
            topic.add(self._put_result, lambda: self._results.dropped)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._reception.on_feedback.remove(self._put_feedback)
        if self._channel is not None:
            self._channel.topic.remove(self._put_frame)
        for topic in self._topics:
            topic.remove(self._put_result)

    @property
    def waiting(self) -> bool:
        """Whether there is something to take."""
        return self._feedback.waiting or self._frames.waiting or self._results.waiting

    @property
    def feedback_dropped(self) -> int:
        """Samples that newer ones pushed out."""
        return self._feedback.dropped

    @property
    def frames_dropped(self) -> int:
        """Frames that newer ones pushed out."""
        return self._frames.dropped

    @property
    def results_dropped(self) -> int:
        """Results that newer ones pushed out."""
        return self._results.dropped - self._results.expired

    @property
    def results_expired(self) -> int:
        """Results that were too old when their turn came."""
        return self._results.expired

    def feedback(self) -> Feedback | None:
        """The newest, if it was not taken yet."""
        return self._feedback.take()

    def frame(self) -> Frame | None:
        """The newest, if it was not taken yet."""
        arrival = self._frames.take()
        return None if arrival is None or self._channel is None else self._channel.picture(arrival)

    def result(self) -> Result | None:
        """The newest of a processor, if it was not taken yet and is not too old."""
        return self._results.take()
