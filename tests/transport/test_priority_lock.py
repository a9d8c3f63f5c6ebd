"""A lock that is granted in order of arrival, commands first."""

from __future__ import annotations

import threading

from skyloop.messages import Command, Hover, Ping, Request, encode
from skyloop.transport.priority import PriorityLock, is_command
from skyloop.transport.testing import wait_until


def test_only_commands_are_urgent() -> None:
    assert is_command(encode(Command(1, 1, 1, 1, Hover())))
    assert not is_command(encode(Request(1, Ping(1))))
    assert not is_command(b"")


def queue_up(turns: PriorityLock, came: list[str], name: str, *, first: bool = False) -> threading.Thread:
    """Start a thread that waits for its turn."""

    def wait() -> None:
        turns.acquire(first)
        came.append(name)
        turns.release()

    before = turns.waiting
    thread = threading.Thread(target=wait)
    thread.start()
    wait_until(lambda: turns.waiting == before + 1, f"{name} waits")
    return thread


def test_urgent_waiters_come_first_and_the_others_in_order() -> None:
    turns, came = PriorityLock(), list[str]()
    with turns:
        assert turns.held
        with turns:  # the same thread may acquire it again
            threads = [queue_up(turns, came, name) for name in ("one", "two")]
            threads.append(queue_up(turns, came, "command", first=True))
        threads.append(queue_up(turns, came, "three"))
        assert came == []
    for thread in threads:
        thread.join()
    assert came == ["command", "one", "two", "three"]
    assert not turns.held


def test_a_thread_that_keeps_acquiring_lets_each_waiter_go_first() -> None:
    """With ``threading.RLock``, the others get it only by chance."""
    turns, came = PriorityLock(), list[str]()
    ended = threading.Event()

    def take_always() -> None:
        while not ended.is_set():
            with turns:
                came.append("greedy")

    with turns:
        greedy = threading.Thread(target=take_always)
        greedy.start()
        wait_until(lambda: turns.waiting == 1, "it waits")
        others = [queue_up(turns, came, name) for name in ("one", "two", "three")]
    for thread in others:
        thread.join()
    ended.set()
    greedy.join()
    assert came[:4] == ["greedy", "one", "two", "three"]
