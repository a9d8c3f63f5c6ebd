"""Requests and answers, matched by number."""

from __future__ import annotations

import pytest

from skyloop.client.session import Requests
from skyloop.clock import ManualClock
from skyloop.errors import ClosedError, LinkError, NoAnswerError
from skyloop.messages import AnyReply, Done, Ping, Pong, Reply, Request, decode


class Bench:
    def __init__(self) -> None:
        self.clock = ManualClock()
        self.sent: list[Request] = []
        self.answers: list[AnyReply | LinkError] = []
        self.requests = Requests(self.send)

    def send(self, packet: bytes) -> bool:
        request = decode(packet)
        assert isinstance(request, Request)
        self.sent.append(request)
        return True

    def ask(self, timeout_s: float = 1.0) -> int:
        self.requests.ask(Ping(5), self.answers.append, timeout_s, self.clock())
        return self.sent[-1].id


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_answers_match_their_requests_in_any_order(bench: Bench) -> None:
    first, second = bench.ask(), bench.ask()
    assert first != second
    assert bench.requests.answered(Reply(second, Done()))
    assert bench.requests.answered(Reply(first, Pong(5, 6)))
    assert bench.answers == [Done(), Pong(5, 6)]


def test_duplicate_and_unrequested_answers_are_ignored(bench: Bench) -> None:
    number = bench.ask()
    assert bench.requests.answered(Reply(number, Done()))
    assert not bench.requests.answered(Reply(number, Done()))
    assert not bench.requests.answered(Reply(999, Done()))
    assert bench.answers == [Done()]


def test_an_unanswered_request_is_repeated_and_then_abandoned(bench: Bench) -> None:
    number = bench.ask(timeout_s=1.0)
    for _ in range(11):
        bench.clock.advance(0.1)
        bench.requests.tick(bench.clock())
    assert [request.id for request in bench.sent] == [number] * 4
    assert len(bench.answers) == 1
    assert isinstance(bench.answers[0], NoAnswerError)
    assert "Ping within 1 s" in str(bench.answers[0])
    bench.clock.advance(5.0)
    bench.requests.tick(bench.clock())
    assert len(bench.sent) == 4


def test_a_lost_connection_fails_all_requests_now_and_later(bench: Bench) -> None:
    bench.ask()
    bench.ask()
    bench.requests.fail(ClosedError("gone"))
    bench.requests.ask(Ping(5), bench.answers.append, 1.0, bench.clock())
    assert [str(answer) for answer in bench.answers] == ["gone"] * 3
    assert len(bench.sent) == 2
