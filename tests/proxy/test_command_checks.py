"""The command checks: each as a table, and properties of the sequence and age filters."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.messages import (
    ACTION_NAMES,
    Action,
    AnyAction,
    Attitude,
    Command,
    EmergencyStop,
    FlightState,
    Hover,
    Idle,
    Land,
    Refusal,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.proxy.core.command_checks import STATE_POLICIES, Intents, StatePolicy, explain, explain_state

NOW = 100 * NS_PER_S
MAX_AGE = NS_PER_S // 4
MS = 1_000_000
LEASE = 3


def receive(
    sequence: Intents,
    *,
    seq: int = 1,
    lease: int = LEASE,
    intent: int = 1,
    sent_ns: int = NOW,
    action: AnyAction = Hover(),  # noqa: B008  frozen
    holds: bool = True,
) -> Refusal | None:
    return sequence.check(Command(seq, lease, intent, sent_ns, action), NOW, MAX_AGE, LEASE, holds)


def test_a_good_command_passes() -> None:
    assert receive(Intents()) is None


def test_the_sequence_grows_strictly() -> None:
    sequence = Intents()
    assert receive(sequence, seq=0) is None
    assert receive(sequence, seq=5) is None
    assert receive(sequence, seq=5) is Refusal.OUT_OF_SEQUENCE
    assert receive(sequence, seq=4) is Refusal.OUT_OF_SEQUENCE
    assert receive(sequence, seq=6) is None


def test_a_refused_command_still_counts_for_the_sequence() -> None:
    sequence = Intents()
    assert receive(sequence, seq=5, sent_ns=0) is Refusal.STALE
    assert receive(sequence, seq=4) is Refusal.OUT_OF_SEQUENCE


@pytest.mark.parametrize(
    ("age_ms", "expected"),
    [(0, None), (250, None), (251, Refusal.STALE), (-50, None), (-51, Refusal.STALE), (99_999, Refusal.STALE)],
)
def test_the_age_has_both_bounds(age_ms: int, expected: Refusal | None) -> None:
    assert receive(Intents(), sent_ns=NOW - age_ms * MS) is expected


@pytest.mark.parametrize(
    ("lease", "holds", "expected"),
    [
        (LEASE, True, None),
        (LEASE, False, Refusal.NO_AUTHORITY),  # the right number from the wrong application
        (0, True, Refusal.NO_AUTHORITY),
        (0, False, Refusal.NO_AUTHORITY),
        (LEASE - 1, True, Refusal.FOREIGN_LEASE),
        (LEASE - 1, False, Refusal.FOREIGN_LEASE),
        (LEASE + 1, True, Refusal.FOREIGN_LEASE),
    ],
)
def test_only_the_holders_lease_in_force_counts(lease: int, holds: bool, expected: Refusal | None) -> None:
    assert receive(Intents(), lease=lease, holds=holds) is expected


def test_nothing_flies_without_a_lease_in_force() -> None:
    command = Command(1, 0, 1, NOW, Hover())
    assert Intents().check(command, NOW, MAX_AGE, 0, False) is Refusal.NO_AUTHORITY


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", [Velocity, Attitude])
@pytest.mark.parametrize("place", range(4))
def test_numbers_must_be_finite(bad: float, kind: type[Velocity | Attitude], place: int) -> None:
    numbers = [0.0] * 4
    numbers[place] = bad
    assert receive(Intents(), action=kind(*numbers)) is Refusal.NON_FINITE


S = FlightState
_POLICY_TABLE: list[tuple[type[Action], str]] = [
    # unknown, landed, taking_off, hovering, flying, landing, emergency
    (Idle, "HOLD HOLD HOLD HOLD HOLD HOLD HOLD"),
    (Takeoff, "APPLY APPLY HOLD HOVER HOVER HOVER REFUSE"),
    (Hover, "APPLY HOLD APPLY APPLY APPLY APPLY REFUSE"),
    (Land, "APPLY HOLD APPLY APPLY APPLY HOLD REFUSE"),
    (ResetEmergency, "APPLY REFUSE REFUSE REFUSE REFUSE REFUSE APPLY"),
    (Attitude, "APPLY REFUSE HOLD APPLY APPLY HOLD REFUSE"),
    (Velocity, "APPLY REFUSE HOLD APPLY APPLY HOLD REFUSE"),
]


@pytest.mark.parametrize(("kind", "row"), _POLICY_TABLE)
def test_each_action_in_each_flight_state(kind: type[Action], row: str) -> None:
    states = [S.UNKNOWN, S.LANDED, S.TAKING_OFF, S.HOVERING, S.FLYING, S.LANDING, S.EMERGENCY]
    assert [STATE_POLICIES[kind][state].name for state in states] == row.split()


def test_every_action_but_the_emergency_stop_has_a_policy_for_every_state() -> None:
    assert set(STATE_POLICIES) == set(ACTION_NAMES) - {EmergencyStop}
    for row in STATE_POLICIES.values():
        assert set(row) == set(FlightState)


@pytest.mark.parametrize(
    ("reason", "command", "words"),
    [
        (Refusal.OUT_OF_SEQUENCE, Command(3, LEASE, 1, NOW, Hover()), ["3", "7"]),
        (Refusal.STALE, Command(9, LEASE, 1, NOW - NS_PER_S, Hover()), ["1.000 s old", "0.25", "command.max_age_s"]),
        (Refusal.STALE, Command(9, LEASE, 1, NOW + NS_PER_S, Hover()), ["1.000 s in the future", "0.05"]),
        (Refusal.FOREIGN_LEASE, Command(9, 2, 1, NOW, Hover()), ["lease 2", "lease 3"]),
        (Refusal.NO_AUTHORITY, Command(9, 0, 1, NOW, Hover()), ["request it"]),
        (Refusal.NON_FINITE, Command(9, LEASE, 1, NOW, Velocity(math.nan)), ["velocity", "NaN"]),
    ],
)
def test_refusals_name_the_remedy(reason: Refusal, command: Command, words: list[str]) -> None:
    text = explain(reason, command, 7, now_ns=NOW, max_age_ns=MAX_AGE, lease=LEASE)
    for word in words:
        assert word in text


def test_a_foreign_lease_without_one_in_force_is_explained() -> None:
    command = Command(9, 2, 1, NOW, Hover())
    assert "no lease" in explain(Refusal.FOREIGN_LEASE, command, -1, now_ns=NOW, max_age_ns=MAX_AGE, lease=0)


@pytest.mark.parametrize(("kind", "row"), _POLICY_TABLE)
def test_each_refused_state_is_explained(kind: type[Action], row: str) -> None:
    for state, plan in STATE_POLICIES[kind].items():
        if plan is StatePolicy.REFUSE:
            text = explain_state(kind(), state)
            assert ACTION_NAMES[kind] in text or state.value in text


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(-(10**9), 10**9)), max_size=60))
def test_accepted_commands_are_strictly_newer_and_young(packets: list[tuple[int, int]]) -> None:
    sequence = Intents()
    accepted = [(seq, age) for seq, age in packets if receive(sequence, seq=seq, sent_ns=NOW - age) is None]
    assert all(before[0] < after[0] for before, after in pairwise(accepted))
    assert all(-50 * MS <= age <= MAX_AGE for _, age in accepted)
