"""``docs/proxy.md`` matches the code."""

from __future__ import annotations

from pathlib import Path

from skyloop.messages import Fate, FlightState, Refusal
from skyloop.messages.command import ENDINGS
from skyloop.proxy import publisher, relay, requests, serve
from skyloop.proxy.core import command_checks, failsafe
from skyloop.proxy.parameters import MAX_PARAMETER

PAGE = (Path(__file__).parents[2] / "docs" / "proxy.md").read_text(encoding="utf-8")
_POLICIES = {"done": "APPLY", "hover": "HOVER", "refused": "REFUSE", "nothing to do": "HOLD"}


def rows(first_cell: str) -> list[list[str]]:
    """Return the cells of the table whose header starts with this cell."""
    lines = PAGE.splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith(f"| {first_cell} |"))
    table = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        table.append([cell.strip() for cell in line.strip("|").split("|")])
    return table


def test_the_table_of_flight_states_matches_the_code() -> None:
    kinds = ["Takeoff", "Hover", "Land", "Velocity", "ResetEmergency"]
    plans = {kind.__name__: plan for kind, plan in command_checks.STATE_POLICIES.items()}
    assert plans["Attitude"] == plans["Velocity"]
    seen = set()
    for names, *cells in rows("state"):
        for name in names.split(", "):
            state = FlightState(name.replace(" ", "_"))
            seen.add(state)
            for kind, cell in zip(kinds, cells, strict=True):
                expected = _POLICIES.get(cell, "HOLD" if cell.endswith("continues") else "?")
                assert plans[kind][state].name == expected, (kind, state)
    assert seen == set(FlightState)


def test_every_reason_for_refusing_a_command_is_named() -> None:
    for reason in (
        Refusal.OUT_OF_SEQUENCE,
        Refusal.STALE,
        Refusal.FOREIGN_LEASE,
        Refusal.NO_AUTHORITY,
        Refusal.NON_FINITE,
        Refusal.NOT_FRESH,
        Refusal.VEHICLE_LINK_LOST,
        Refusal.UNSUPPORTED,
        Refusal.WRONG_STATE,
        Refusal.BUSY,
    ):
        assert f"`{reason.value}`" in PAGE


def test_numbers_other_than_parameters_match_the_code() -> None:
    for sentence in (
        f"at most {command_checks.MAX_AHEAD_NS / 1e9:g} s in the future",
        f"than {requests.MAX_MALFORMED} malformed packets within a second",
        f"At most {requests.MAX_PENDING} requests",
        f"more than {MAX_PARAMETER} bytes",
        f"up to {relay.MAX_ANNOTATION} bytes",
        f"it rose by {failsafe.BATTERY_REARM:g} above",
        f"for at most {serve.LAND_WITHIN_S:g} s",
        f"at least {1e9 / publisher.KEEP_ALIVE_NS:g} times a second",
    ):
        assert sentence in " ".join(PAGE.split())
    assert f"within {command_checks.TAKEOFF_NS / 1e9:g} s" in ENDINGS[Fate.TIMED_OUT]
