"""Listeners, each with its own pace and its own errors; Notifier and Mailbox."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.client.channels import Channel, Listener, Mailbox, Notifier

WAIT_S = 10.0


class Bench:
    def __init__(self) -> None:
        self.changes: list[bool] = []
        self.reports: list[tuple[str, str]] = []
        self.channel: Channel[int] = Channel(self.changes.append)

    def report(self, where: str, error: Exception) -> None:
        self.reports.append((where, str(error)))

    def listen(self, function: object, **options: object) -> Listener[int]:
        return Listener(function, self.channel, self.report, name="mine", **options)  # type: ignore[arg-type]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_slow_listener_gets_the_newest_and_a_fast_one_everything(bench: Bench) -> None:
    entered, go_on, done = threading.Event(), threading.Event(), threading.Event()
    slow_got: list[int] = []
    quick_got: list[int] = []

    def slow(number: int) -> None:
        slow_got.append(number)
        entered.set()
        go_on.wait(WAIT_S)
        if number == 9:
            done.set()

    with bench.listen(slow) as slow_listener, bench.listen(quick_got.append, inline=True) as quick_listener:
        bench.channel.publish(0)
        assert entered.wait(WAIT_S)
        for number in range(1, 10):
            bench.channel.publish(number)
        go_on.set()
        assert done.wait(WAIT_S)
        assert (slow_listener.delivered, slow_listener.dropped) == (2, 8)
        assert (quick_listener.delivered, quick_listener.dropped) == (10, 0)
        assert bench.channel.dropped == 8
    assert slow_got == [0, 9]
    assert quick_got == list(range(10))
    assert bench.channel.dropped == 8, "drops of removed listeners still count"


def test_the_first_subscribes_and_the_last_unsubscribes(bench: Bench) -> None:
    first = bench.listen(lambda _: None)
    second = bench.listen(lambda _: None, inline=True)
    first.cancel()
    assert bench.changes == [True]
    second.cancel()
    second.cancel()
    assert bench.changes == [True, False]


@pytest.mark.parametrize("inline", [True, False])
def test_a_raising_listener_is_reported_and_goes_on(
    bench: Bench, caplog: pytest.LogCaptureFixture, inline: bool
) -> None:
    seen = threading.Semaphore(0)

    def raising(number: int) -> None:
        seen.release()
        raise RuntimeError(f"no {number}")

    other: list[int] = []
    with (
        caplog.at_level(logging.ERROR),
        bench.listen(raising, inline=inline) as listener,
        bench.listen(other.append, inline=True),
    ):
        for number in range(3):
            bench.channel.publish(number)
            assert seen.acquire(timeout=WAIT_S)
    assert (listener.errors, listener.delivered) == (3, 3)
    assert bench.reports == [("mine", "no 0")], "a failing listener is reported once a second"
    assert other == [0, 1, 2]
    assert "RuntimeError('no 0')" in caplog.text


def test_a_listener_may_cancel_itself(bench: Bench) -> None:
    done = threading.Event()

    def once(number: int) -> None:
        listener.cancel()
        done.set()

    listener = bench.listen(once)
    bench.channel.publish(1)
    assert done.wait(WAIT_S)
    assert listener._thread is not None
    listener._thread.join(WAIT_S)
    assert not listener._thread.is_alive()
    bench.channel.publish(2)
    assert listener.delivered == 1


def test_nothing_is_called_after_cancel(bench: Bench) -> None:
    got: list[int] = []
    listener = bench.listen(got.append)
    listener.cancel()
    bench.channel.publish(1)
    assert got == []
    assert listener._thread is not None
    assert not listener._thread.is_alive()


def in_thread(function: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=function)
    thread.start()
    return thread


def test_ready_at_once_and_time_out() -> None:
    notifier = Notifier()
    assert notifier.wait_for(lambda: True, 0.0)
    assert not notifier.wait_for(lambda: False, 0.0)
    assert not notifier.wait_for(lambda: False, 0.01)
    assert notifier._waiting == []  # a timed-out waiter leaves nothing behind


def test_all_waiters_are_woken() -> None:
    notifier, rung = Notifier(), threading.Event()
    woken: list[bool] = []
    threads = [in_thread(lambda: woken.append(notifier.wait_for(rung.is_set, 10.0))) for _ in range(5)]
    rung.set()
    notifier.notify()
    for thread in threads:
        thread.join(10.0)
    assert woken == [True] * 5


def test_a_notification_between_check_and_sleep_is_not_missed() -> None:
    notifier = Notifier()
    looks: list[int] = []

    def ready() -> bool:
        looks.append(len(looks))
        if len(looks) == 2:  # the waiter has added its lock and checks again: now it becomes true
            notifier.notify()
            return False
        return len(looks) > 2

    assert notifier.wait_for(ready, 10.0)
    assert len(looks) == 3


def test_many_hand_overs_lose_nothing() -> None:
    buffer: Mailbox[int] = Mailbox(10_000)
    got: list[int | None] = []
    thread = in_thread(lambda: got.extend(buffer.wait(10.0) for _ in range(2000)))
    for number in range(2000):
        buffer.put(number)
    thread.join(20.0)
    assert got == list(range(2000))


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 4))
def test_the_newest_win_and_everything_is_counted(puts: list[bool], depth: int) -> None:
    buffer: Mailbox[int] = Mailbox(depth)
    offered, model, dropped, taken = 0, [], 0, 0
    for put in puts:
        if put:
            offered += 1
            buffer.put(offered)
            model.append(offered)
            if len(model) > depth:
                model.pop(0)
                dropped += 1
        else:
            expected = model.pop(0) if model else None
            taken += expected is not None
            assert buffer.take() == expected
    assert (buffer.dropped, buffer.delivered, buffer.waiting) == (dropped, taken, bool(model))


def test_closing_wakes_and_drops_nothing() -> None:
    buffer: Mailbox[int] = Mailbox()
    got: list[int | None] = []
    thread = in_thread(lambda: got.append(buffer.wait()))
    buffer.close()
    thread.join(10.0)
    assert got == [None]
    buffer = Mailbox()
    buffer.put(1)
    buffer.close()
    assert buffer.wait(1.0) is None
    assert buffer.dropped == 0
