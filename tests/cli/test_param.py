"""Parameters on the command line: typed and shown values, with a real proxy behind."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

import skyloop
from skyloop.cli.param import allowed, details, parse_value, show, table
from skyloop.errors import UsageError
from skyloop.messages import Parameter, ParameterType, Value
from tests.support.commands import Run
from tests.support.processes import Process

BOOL = Parameter("sim.link", ParameterType.BOOL, True)
INT = Parameter("a.count", ParameterType.INT, 3, minimum=1.0)
FLOAT = Parameter("limits.tilt", ParameterType.FLOAT, 0.2, "rad", 0.02, 0.6, 0.21, description="greatest tilt")
VECTOR = Parameter("sim.wind", ParameterType.VECTOR, (0.1, 0.0, -0.5), "m/s", -20.0, 20.0)
TEXT = Parameter("a.mode", ParameterType.TEXT, "near", choices=("near", "far"))


@pytest.mark.parametrize(
    ("parameter", "text", "value"),
    [
        (BOOL, "true", True),
        (BOOL, "Off", False),
        (BOOL, "1", True),
        (INT, "-7", -7),
        (FLOAT, "1e-1", 0.1),
        (FLOAT, "2", 2.0),
        (VECTOR, "1,2,-3", (1.0, 2.0, -3.0)),
        (VECTOR, "(1, 2 3.5)", (1.0, 2.0, 3.5)),
        (VECTOR, "[0.5]", (0.5,)),
        (TEXT, " as it is ", " as it is "),
    ],
)
def test_typed_text_becomes_a_value_of_the_parameters_type(parameter: Parameter, text: str, value: Value) -> None:
    parsed = parse_value(parameter, text)
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("parameter", "text", "kind"),
    [
        (BOOL, "maybe", "true or false"),
        (INT, "1.5", "a whole number"),
        (FLOAT, "steep", "a number"),
        (VECTOR, "1,x", "numbers such as"),
    ],
)
def test_invalid_text_is_answered_with_the_expected_kind(parameter: Parameter, text: str, kind: str) -> None:
    with pytest.raises(UsageError, match=f"{parameter.name} takes {kind}.*not '{text}'"):
        parse_value(parameter, text)


@given(st.lists(st.floats(-1e6, 1e6).map(lambda x: float(f"{x:.6g}")), min_size=1, max_size=6).map(tuple))
def test_a_vector_that_is_shown_can_be_typed_again(vector: tuple[float, ...]) -> None:
    assert parse_value(VECTOR, show(vector)) == vector


@pytest.mark.parametrize(
    ("parameter", "words"),
    [
        (BOOL, "true or false"),
        (INT, "at least 1"),
        (FLOAT, "0.02 to 0.6"),
        (VECTOR, "-20 to 20 each"),
        (TEXT, "near, far"),
        (Parameter("a", ParameterType.FLOAT, 0.0, maximum=0.0), "at most 0"),
        (Parameter("a", ParameterType.FLOAT, 0.0, read_only=True), "read-only"),
        (Parameter("a", ParameterType.FLOAT, 0.0), ""),
    ],
)
def test_allowed_values_are_described_in_words(parameter: Parameter, words: str) -> None:
    assert allowed(parameter) == words


def test_several_are_a_table_and_one_is_shown_in_full() -> None:
    assert table([FLOAT, BOOL]) == [
        "PARAMETER    VALUE    ALLOWED",
        "limits.tilt  0.2 rad  0.02 to 0.6",
        "sim.link     true     true or false",
    ]
    assert details(FLOAT) == [
        "limits.tilt  0.2 rad",
        "  allowed    0.02 to 0.6",
        "  default    0.21",
        "  what       greatest tilt",
    ]


# With a proxy --------------------------------------------------------------------------------------------------


@pytest.mark.daily
@pytest.mark.process
def test_all_some_and_one_are_shown(run: Run, alpha: Process) -> None:
    every = run("param", "alpha")
    assert every.code == 0
    assert "failsafe.hover" in every.out
    assert max(map(len, every.out.splitlines())) <= 80
    some = run("param", "alpha", "limits").out.splitlines()[1:]
    assert len(some) > 2
    assert all(line.startswith("limits.") for line in some)
    assert "greatest roll and pitch" in run("param", "alpha", "limits.tilt").out
    (one,) = json.loads(run("param", "alpha", "limits.tilt", "--json").out)
    assert (one["name"], one["unit"]) == ("limits.tilt", "rad")


@pytest.mark.process
def test_values_are_written(run: Run, alpha: Process) -> None:
    assert "0.3 rad" in run("param", "alpha", "limits.tilt", "0.3").out
    assert "0.25 rad" in run("param", "alpha", "limits.tilt=0.25").out
    assert "0.3 rad" in run("param", "alpha", "limits.tilt", "0.3").out
    assert "-1,0.5,0 m/s" in run("param", "alpha", "sim.wind", "-1,0.5,0").out
    with skyloop.connect("alpha", access="observe") as drone:
        assert drone.config["limits.tilt"] == 0.3
        assert drone.config["sim.wind"] == (-1.0, 0.5, 0.0)


@pytest.mark.process
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["limits.tit"], "no parameter named 'limits.tit'; did you mean 'limits.tilt'"),
        (["limits.tit", "0.2"], "did you mean 'limits.tilt'"),
        (["limits.tilt", "steep"], "limits.tilt takes a number, not 'steep'"),
        (["limits.tilt", "9"], "limits.tilt must be at least 0.02 rad and at most 0.6 rad, not 9.0"),
        (["limits.tilt", "nan"], "limits.tilt must be finite"),
        (["sim.wind", "1,2"], "sim.wind takes 3 numbers, not 2"),
        (["--prioriti", "3"], "no parameter named '--prioriti'"),
    ],
)
def test_errors_are_reported_in_one_line(run: Run, alpha: Process, words: list[str], said: str) -> None:
    ended = run("param", "alpha", *words)
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err
    assert len(ended.err.splitlines()) == 1


@pytest.mark.process
def test_writing_while_another_pilot_flies_says_who_and_what_to_do(run: Run, alpha: Process) -> None:
    with skyloop.connect("alpha", name="the pilot"):
        ended = run("param", "alpha", "limits.tilt", "0.2")
        assert ended.code == 1
        assert ended.err.startswith("skyloop: the pilot holds the authority over alpha: ")
        assert "--priority" in ended.err
        assert run("param", "alpha", "limits.tilt", "0.25", "--priority", "3").code == 0
