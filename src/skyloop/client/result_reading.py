"""What processors find, and being one of their workers: the part of a drone that has to do with results."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from skyloop.client.membership import Membership
from skyloop.client.reading import EVENT_DEPTH, Reading
from skyloop.client.results import Result, ResultChannel, ResultListener, ResultSlot, checked_age, checked_name, is_old
from skyloop.errors import NoAnswerError, UsageError
from skyloop.messages.result import MAX_CODE


class ResultReading(Reading):
    """Reads are named as those of frames. A limit of age is judged when a result's turn comes, by the time since the
    capture of its frame, on the proxy's clock."""

    def result(self, processor: str, *, max_age_s: float | None = None) -> Result | None:
        """The newest result, None until one came or if it is older than ``max_age_s``. The first call subscribes."""
        checked_age(max_age_s)
        channel = self.result_channel(processor)
        channel.keep_newest()
        newest = channel.newest
        return None if newest is None or is_old(newest, max_age_s) else newest

    def results(self, processor: str, *, max_age_s: float | None = None, timeout_s: float = 5.0) -> Iterator[Result]:
        """Each newest result of a processor, until the drone is closed. Slow loops skip some, and those older than
        ``max_age_s`` are left out; both are counted in :attr:`stats`. Raises :class:`NoAnswerError`."""
        slot = ResultSlot(checked_age(max_age_s), self._reception.pace.bell())
        channel = self.result_channel(processor)
        self._check_may_wait()
        sink = slot.put
        self._buffers.append(slot)
        channel.topic.add(sink, lambda: slot.dropped)
        try:
            while not self._closed:
                result = slot.wait(timeout_s)
                if result is not None:
                    yield result
                elif not slot.closed:
                    raise NoAnswerError(silence(processor, timeout_s, slot.expired))
        finally:
            channel.topic.remove(sink)
            self._buffers.remove(slot)

    def on_result(
        self,
        function: Callable[[Result], object],
        processor: str | None = None,
        *,
        max_age_s: float | None = None,
        depth: int | None = None,
        inline: bool = False,
    ) -> ResultListener:
        """Call with the results of a processor, on a thread of its own that takes the newest ``depth`` (default 1), or
        inline on the receiving one. With no processor named with all results of all, of which 256 may wait.

        Results older than ``max_age_s`` are left out, counted in ``expired`` of the listener.
        """
        if depth is not None and depth < 1:
            raise UsageError(f"depth is {depth!r} and must be at least 1 result")
        self._check_listener(function)
        topic = self._reception.results.everything if processor is None else self.result_channel(processor).topic
        listener = ResultListener(
            function,
            topic,
            self._report,
            name="results" if processor is None else f"results of {processor}",
            depth=depth or (EVENT_DEPTH if processor is None else 1),
            inline=inline or self._reception.pace.in_step,
            on_cancel=self._cancelled,
            max_age_s=checked_age(max_age_s),
        )
        self._listeners.append(listener)
        return listener

    def join_processor(
        self, name: str, *, code: str, camera: str | None = None, shared: bool = True, timeout_s: float = 5.0
    ) -> Membership:
        """Be a worker of a processor: what ``skyloop process`` does, for programs that do it in their own way.

        ``code`` tells what runs, and is the same for all workers of a name; ``shared``: each frame goes to one of them,
        else all take all. Raises :class:`NameTakenError` if somebody else runs other code under that name.
        """
        self._check_may_wait()
        if not isinstance(code, str) or len(code) > MAX_CODE:
            raise UsageError(f"code is {code!r:.80} and must be a text of at most {MAX_CODE} characters")
        membership = Membership(
            self._link, self._reception, checked_name(name), code, self.channel(camera).camera.name, shared=shared
        )
        membership.start(timeout_s)
        self._buffers.append(membership)  # ends with the drone
        return membership

    def result_channel(self, processor: str) -> ResultChannel:
        """The channel of a processor, whether or not one of that name works."""
        self._check_open()
        return self._reception.results.channel(checked_name(processor))


def silence(processor: str, timeout_s: float, expired: int) -> str:
    """What is said when no result came."""
    if expired:
        return f"no result of {processor} came within {timeout_s:g} s that was new enough; {expired} were too old"
    return (
        f"no result of processor {processor} came within {timeout_s:g} s: does skyloop process run one of that name "
        "for this drone?"
    )
