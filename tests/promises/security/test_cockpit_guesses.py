"""Guessing tokens is slow, and does not lock out anyone who has one."""

from __future__ import annotations

import http.client
import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from skyloop.clock import ManualClock
from skyloop.cockpit import Access
from skyloop.cockpit.access import (
    EACH_IN_ALL_S,
    FIRST_S,
    FORGET_S,
    FREE_IN_ALL,
    LONGEST_S,
    MAX_ADDRESSES,
    MOST_IN_ALL_S,
    Token,
    TokenGate,
    WrongTokens,
)
from tests.support.cockpit_page import PILOT, ask, served

GUESSERS = 8


def test_each_wrong_token_of_an_address_waits_twice_as_long_up_to_a_limit() -> None:
    wrong = WrongTokens(ManualClock())
    assert [wrong.another("a") for _ in range(8)] == [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 16.0]
    assert wrong.another("b") == FIRST_S, "another address has its own count"
    assert wrong.count == 9


def test_an_address_that_is_quiet_for_long_starts_afresh() -> None:
    clock = ManualClock()
    wrong = WrongTokens(clock)
    for _ in range(5):
        wrong.another("a")
    clock.advance(FORGET_S - 1)
    assert wrong.another("a") == 8.0
    clock.advance(FORGET_S)
    assert wrong.another("a") == FIRST_S


def test_many_addresses_together_wait_too() -> None:
    clock = ManualClock()
    wrong = WrongTokens(clock)
    for number in range(FREE_IN_ALL):
        assert wrong.another(f"address {number}") == FIRST_S
    assert wrong.another("one more") == FIRST_S + EACH_IN_ALL_S
    for number in range(1000):
        last = wrong.another(f"bot {number}")
    assert last == FIRST_S + MOST_IN_ALL_S
    clock.advance(60)
    assert wrong.another("later") == FIRST_S


def test_the_number_of_remembered_addresses_is_bounded(caplog: pytest.LogCaptureFixture) -> None:
    wrong = WrongTokens(ManualClock())
    for number in range(MAX_ADDRESSES + 10):
        wrong.another(f"{number}")
    for _ in range(100):
        assert 0 < wrong.another("a") <= LONGEST_S
    assert len(wrong._of_address) == MAX_ADDRESSES
    assert sum("from a" in record.message for record in caplog.records) == 7, "1, 2, 4, … 64"


def test_a_guesser_that_is_gone_is_logged_as_such(caplog: pytest.LogCaptureFixture) -> None:
    gate = TokenGate(list[Token](), "c", ManualClock())
    assert gate.wrong_token_s({"client": None}) == FIRST_S
    assert gate.wrong_token_s({"client": ("10.0.0.1", 1)}) == FIRST_S
    assert [record.message for record in caplog.records] == [
        "1 wrong tokens from a disconnected client",
        "1 wrong tokens from 10.0.0.1",
    ]


@pytest.mark.parametrize("by", ["header", "login"])
def test_a_guesser_gets_few_answers_while_the_right_token_is_accepted(
    by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    tokens = tmp_path / "tokens"
    tokens.write_text(f"pilot {PILOT} ann\n")
    tokens.chmod(0o600)
    answers: list[int] = []
    ended = threading.Event()

    def guess(address: str, number: int) -> None:
        line = http.client.HTTPConnection(address.removeprefix("http://"), timeout=0.5)
        while not ended.is_set():
            token = f"wrong-token-{number}-{len(answers):010d}"
            try:
                if by == "header":
                    line.request("GET", "/api/session", headers={"Authorization": f"Bearer {token}"})
                else:
                    line.request("POST", "/api/login", json.dumps({"token": token}), login_headers(address))
                answers.append(line.getresponse().status)
                line.close()
            except OSError:
                line.close()  # not answered in time: the next one is tried over a new connection

    with served(access=Access(token_file=tokens)) as address:
        guessers = [threading.Thread(target=guess, args=(address, number)) for number in range(GUESSERS)]
        for guesser in guessers:
            guesser.start()
        try:
            deadline = time.monotonic() + 1.5
            while time.monotonic() < deadline:
                began = time.monotonic()
                assert ask(address, "/api/session", PILOT)["role"] == "pilot"
                assert time.monotonic() - began < 4.0
        finally:
            ended.set()
            for guesser in guessers:
                guesser.join()
        assert ask(address, "/api/statistics", PILOT)["wrong_tokens"] >= GUESSERS
    assert len(answers) <= 4, "0.25, 0.5, 1, 2, … s"
    assert set(answers) <= {401}


def login_headers(address: str) -> dict[str, Any]:
    return {"Content-Type": "application/json", "Origin": address}
