"""Notifier and Mailbox."""

from __future__ import annotations

import threading
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from skyloop.client.channels import Mailbox, Notifier


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
