"""Colour in terminals that support it, and nowhere else."""

from __future__ import annotations

import io

import pytest

from skyloop.cli.text import coloured


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def a_usual_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")


def test_important_words_are_coloured_in_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    assert coloured("skyloop: no file", Terminal()) == "\x1b[31mskyloop: \x1b[0mno file"
    assert coloured("note: it never took off", Terminal()) == "\x1b[33mnote: \x1b[0mit never took off"
    assert coloured("landing", Terminal()) == "landing"


@pytest.mark.parametrize(("variable", "value"), [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_no_colour_is_respected(monkeypatch: pytest.MonkeyPatch, variable: str, value: str) -> None:
    monkeypatch.setenv(variable, value)
    assert coloured("skyloop: no file", Terminal()) == "skyloop: no file"


def test_a_pipe_gets_plain_text() -> None:
    assert coloured("skyloop: no file", io.StringIO()) == "skyloop: no file"


def test_without_standard_error_nothing_is_coloured_and_nothing_fails() -> None:
    """A flight's reports pass through here: a failure would end it."""
    assert coloured("skyloop: no file", None) == "skyloop: no file"
