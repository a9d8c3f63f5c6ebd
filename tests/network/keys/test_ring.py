"""A running process's keys: its messages, their times, and excluded identities."""

from __future__ import annotations

import os
from datetime import timedelta
from pathlib import Path

import pytest

from skyloop.network.keys import KeyRing, Lab, load
from skyloop.network.keys.identity import make_identity
from tests.network.keys.conftest import NOW

DAY, HOUR = timedelta(days=1), timedelta(hours=1)


@pytest.fixture
def ring(lab: Lab) -> KeyRing:
    """Return a proxy's keys."""
    for name, role, drones in (("alpha", "proxy", "alpha"), ("jane", "pilot", "alpha*"), ("eve", "pilot", "*")):
        lab.issue(make_identity(name, role, drones), now=NOW)
    return KeyRing(load(lab.folder("alpha"), now=NOW))


def test_good_keys_cause_no_message(ring: KeyRing) -> None:
    assert ring.poll(NOW) == []


def test_an_expiry_is_announced_at_once_and_then_hourly(ring: KeyRing) -> None:
    late = NOW + 25 * DAY
    assert [len(ring.poll(late + wait)) for wait in (0 * HOUR, HOUR / 2, HOUR, HOUR * 1.5, HOUR * 2)] == [1, 0, 1, 0, 1]
    assert ring.poll(NOW + 26 * DAY)[0].startswith("the key of alpha expires in 4 days")


def test_a_new_name_on_the_roster_is_announced_once(ring: KeyRing, lab: Lab) -> None:
    lab.issue(make_identity("olga", "observer"), now=NOW)
    (news,) = ring.poll(NOW)
    assert "roster has changed (number 5)" in news
    assert "revoked" not in news
    assert ring.poll(NOW) == []
    assert ring.shut_out == frozenset()


def test_a_renewed_key_is_not_announced(ring: KeyRing, lab: Lab) -> None:
    lab.issue(make_identity("jane", "pilot", "alpha*"), now=NOW + DAY)
    assert ring.poll(NOW) == []
    assert ring.credentials.roster.number == 5


def test_a_revoked_or_changed_identity_is_excluded_at_once(ring: KeyRing, lab: Lab) -> None:
    lab.revoke("eve")
    (news,) = ring.poll(NOW)
    assert "revoked or changed: eve" in news
    lab.issue(make_identity("jane", "observer"), now=NOW)
    (news,) = ring.poll(NOW)
    assert "revoked or changed: eve, jane" in news
    assert ring.shut_out == {"eve", "jane"}
    lab.issue(make_identity("jane", "pilot", "alpha*"), now=NOW)
    ring.poll(NOW)
    assert ring.shut_out == {"eve"}


def test_a_damaged_or_older_roster_changes_nothing(ring: KeyRing, lab: Lab, tmp_path: Path) -> None:
    mine = lab.folder("alpha") / "roster.json"
    good = mine.read_bytes()
    lab.revoke("eve")
    newer = mine.read_bytes()
    ring.poll(NOW)
    mine.write_bytes(newer[:50])
    (news,) = ring.poll(NOW)
    assert "is not a roster" in news
    assert "stays in force" in news
    assert ring.poll(NOW) == []
    mine.write_bytes(good)
    assert ring.poll(NOW) == []
    mine.unlink()
    (news,) = ring.poll(NOW)
    assert "can't be read" in news
    assert ring.shut_out == {"eve"}
    mine.write_bytes(newer)
    os.utime(mine)
    assert ring.poll(NOW) == []
    assert ring.shut_out == {"eve"}
