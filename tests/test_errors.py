"""Errors travel between processes: an error raised in a worker arrives unchanged."""

from __future__ import annotations

import pickle

import pytest

from skyloop.errors import (
    AuthorityError,
    MissingExtraError,
    NoAnswerError,
    SkyloopError,
    SwarmError,
    UnknownNameError,
    shortened,
)


@pytest.mark.parametrize(
    "error",
    [
        UnknownNameError("camera", "frnt", ["front", "bottom"]),
        MissingExtraError("the network", "network", cause="No module named 'zenoh'"),
        MissingExtraError("the network", "network"),
        AuthorityError("ada holds the authority", code="busy"),
        NoAnswerError("nothing came within 5 s"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_arrives_as_it_was(error: SkyloopError) -> None:
    arrived = pickle.loads(pickle.dumps(error))
    assert type(arrived) is type(error)
    assert str(arrived) == str(error)
    public = {name: value for name, value in vars(error).items() if not name.startswith("_")}
    assert {name: getattr(arrived, name) for name in public} == public


def test_a_swarms_error_arrives_with_those_of_its_drones() -> None:
    error = SwarmError("take-off", {"one": NoAnswerError("late")}, 3)
    arrived = pickle.loads(pickle.dumps(error))
    assert str(arrived) == str(error)
    assert arrived.total == 3
    assert str(arrived.errors["one"]) == "late"


def test_a_text_that_is_too_long_keeps_its_beginning_and_its_end() -> None:
    assert shortened("x" * 30, 30) == "x" * 30
    text = shortened(f"RuntimeError('no answer {'.' * 5000} by the radio: it is off')", 100)
    assert len(text) == 100
    assert text.startswith("RuntimeError('no answer")
    assert text.endswith("by the radio: it is off')")
    assert " … " in text
    assert len(shortened("y" * 99, 10)) == 10
