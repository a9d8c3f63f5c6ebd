"""Names, roles and patterns of drones: valid ones, and their matches."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.network.keys.identity import MAX_PATTERNS, KeyRole, make_identity, parse_drones
from skyloop.network.layout import check_identity
from skyloop.transport.base import NAME

NAMES = st.from_regex(NAME, fullmatch=True)


@pytest.mark.parametrize(
    ("name", "role", "drones", "words"),
    [
        ("", "pilot", "*", "cannot be the name of a key"),
        ("Jane", "pilot", "*", "lower-case"),
        ("jane/x", "pilot", "*", "cannot be the name of a key"),
        ("j*", "pilot", "*", "cannot be the name of a key"),
        ("a" * 49, "pilot", "*", "1 to 48"),
        ("anyone", "pilot", "*", "without a key"),
        ("jane", "captain", "*", "pilot, observer, proxy, router"),
        ("jane", "pilot", "", "names no drones"),
        ("jane", "pilot", "alpha,", "names no drones"),
        ("jane", "pilot", "[a-z]", "alpha,bravo*"),
        ("jane", "pilot", "a/b", "names no drones"),
        ("jane", "pilot", ".alpha", "names no drones"),
        ("jane", "pilot", "Alpha", "names no drones"),
        ("jane", "pilot", ",".join(f"d{n}" for n in range(MAX_PATTERNS + 1)), "too many"),
        ("hub", "router", "alpha", "leave out the drones"),
    ],
)
def test_an_invalid_identity_is_reported_with_valid_ones(name: str, role: str, drones: str, words: str) -> None:
    with pytest.raises(UsageError, match=re.escape(words)):
        make_identity(name, role, drones)


@pytest.mark.parametrize(
    ("text", "patterns"),
    [
        ("*", ("*",)),
        ("**", ("*",)),
        ("alpha", ("alpha",)),
        (" alpha , bravo* ", ("alpha", "bravo*")),
        ("alpha,alpha", ("alpha",)),
        ("alpha,*", ("*",)),
        ("a***b", ("a*b",)),
        ("*-sim", ("*-sim",)),
    ],
)
def test_patterns_are_normalised(text: str, patterns: tuple[str, ...]) -> None:
    assert parse_drones(text) == patterns
    assert parse_drones(",".join(patterns)) == patterns


@pytest.mark.parametrize(
    ("drones", "name", "covered"),
    [
        ("alpha", "alpha", True),
        ("alpha", "alpha2", False),
        ("alpha*", "alpha", True),
        ("alpha*", "alpha-7", True),
        ("alpha*", "bravo", False),
        ("alpha,bravo", "bravo", True),
        ("*-sim", "alpha-sim", True),
        ("*-sim", "alpha-simulated", False),
        ("*", "anything.at_all-1", True),
        ("a.c", "abc", False),
    ],
)
def test_which_drones_a_pattern_covers(drones: str, name: str, covered: bool) -> None:
    assert make_identity("jane", "pilot", drones).covers(name) is covered


@pytest.mark.parametrize("role", KeyRole)
def test_keys_are_valid_for_one_role_only(role: KeyRole) -> None:
    identity = make_identity("somebody", role)
    checks: dict[str, Callable[[], None]] = {
        "a proxy needs": lambda: identity.require_proxy("alpha"),
        "a router needs": identity.require_router,
        "an application needs": identity.require_application,
    }
    good = {"proxy": "a proxy needs", "router": "a router needs"}.get(role, "an application needs")
    for words, require in checks.items():
        if words == good:
            require()
        else:
            with pytest.raises(UsageError, match=f"the keys of somebody, {role}.*: {words}"):
                require()


def test_a_proxy_serves_only_its_keys_names() -> None:
    identity = make_identity("hangar", "proxy", "alpha*")
    identity.require_proxy("alpha7")
    with pytest.raises(UsageError, match="not for the name 'bravo'"):
        identity.require_proxy("bravo")


@given(NAMES)
def test_every_proxy_name_can_be_its_keys_and_covers_itself(name: str) -> None:
    if name == "anyone":
        return
    identity = make_identity(name, KeyRole.PROXY, name)
    assert identity.covers(name)
    check_identity(identity.name)
