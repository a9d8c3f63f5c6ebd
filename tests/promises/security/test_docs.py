"""The tables of doors and replays in ``docs/security.md`` are those of the tests."""

from __future__ import annotations

from pathlib import Path

from skyloop.messages import Refusal
from tests.promises.security.deeds import DEEDS
from tests.support.pages import rows, section

HERE = Path(__file__).parent
PAGE = "docs/security.md"
DOORS = {
    "without a key, by QUIC, TLS, TCP or UDP": "a_client_without_a_key_does_not_connect",
    "with a key of the same name from another authority": "a_key_of_another_authority_does_not_connect",
    "with an expired key": "an_expired_key_does_not_connect",
    "with another's certificate and a different key": "anothers_certificate_without_its_key_does_not_connect",
    "with a key that ends while connected": "a_link_ends_with_its_key",
    "a pilot or an observer listens as if it were a proxy": (
        "no_one_connects_to_a_pilot_or_an_observer_that_poses_as_a_proxy"
    ),
    "another drone's proxy listens as if it were this one": (
        "another_drones_proxy_that_listens_as_this_one_is_not_found"
    ),
    "a command, an emergency stop, a request for the authority or a parameter on the Zenoh key of observers": (
        "a_command_sent_by_the_key_for_queries_is_refused_and_reported"
    ),
    "a command for a lease in force, by another pilot's own connection": (
        "recorded_bytes_by_another_pilots_own_connection_are_refused_and_reported"
    ),
    "a command for a connection that never was": "commands_of_a_connection_that_never_existed_are_refused_and_reported",
    "a pilot who is revoked in flight": "a_client_revoked_in_flight_loses_the_drone_and_does_not_come_back",
    "an observer's command, or one in another's name, through a router": (
        "a_router_applies_the_rules_to_those_who_connect_to_it"
    ),
    "serving with a pilot's key, or with one for another name": "our_ends_refuse_keys_of_another_role_or_name",
}
REPLAYS = {
    "again by the same connection": ("again_by_the_same_connection", Refusal.OUT_OF_SEQUENCE),
    "by another pilot while its lease is in force": (
        "by_another_pilot_while_the_holder_flies",
        Refusal.NO_AUTHORITY,
    ),
    "by an observer": ("by_an_observer", Refusal.OBSERVER),
    "by a client that did not send Hello": ("by_a_client_without_a_hello", Refusal.PROTOCOL),
    "by the same pilot under a later lease": ("by_the_same_pilot_under_a_later_lease", Refusal.FOREIGN_LEASE),
    "while no application holds the authority": ("while_no_one_flies", Refusal.FOREIGN_LEASE),
    "after its time, with a newer number": ("after_its_time", Refusal.STALE),
    "with a time in the future": ("before_its_time", Refusal.STALE),
    "after a failsafe, without a new intent of its pilot": ("from_before_the_failsafe", Refusal.NOT_FRESH),
}


def test_each_row_about_the_door_is_a_test() -> None:
    assert [row[0] for row in rows(section(PAGE, "### What was tried"))[len(DEEDS) :]] == list(DOORS)
    for name in DOORS.values():
        assert f"\ndef test_{name}(" in (HERE / "test_doors.py").read_text(), name


def test_each_row_about_replays_is_a_test() -> None:
    table = rows(section(PAGE, "## Replayed commands"))
    assert table == [[words, f"`{reason}`"] for words, (_, reason) in REPLAYS.items()]
    for name, _ in REPLAYS.values():
        assert f"\ndef test_{name}(" in (HERE / "test_replays.py").read_text(), name
