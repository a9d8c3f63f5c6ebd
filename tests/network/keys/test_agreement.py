"""Mutual proof of identity across routers, and the agreed secrets."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import msgspec
import pytest

from skyloop.errors import LinkError
from skyloop.network.keys import KeyRing, Lab, load
from skyloop.network.keys.agreement import Agreement, Proof
from skyloop.network.keys.identity import make_identity
from tests.network.keys.conftest import NOW

TERMS = ("alpha", "run", "jane", "id")


@pytest.fixture
def rings(lab: Lab) -> dict[str, KeyRing]:
    for name, role, drones in (("alpha", "proxy", "alpha"), ("jane", "pilot", "alpha*"), ("eve", "pilot", "*")):
        lab.issue(make_identity(name, role, drones), now=NOW)
    return {name: KeyRing(load(lab.folder(name), now=NOW)) for name in ("alpha", "jane", "eve")}


def test_both_ends_know_each_other_and_share_the_secrets(rings: dict[str, KeyRing]) -> None:
    app, proxy = Agreement(rings["jane"], *TERMS), Agreement(rings["alpha"], *TERMS)
    answer, there = proxy.answer(app.offer(), NOW)
    here = app.accept(answer, NOW)
    assert (here.up, here.down) == (there.up, there.down)
    assert here.up != here.down
    assert (here.identity, there.identity) == (
        make_identity("alpha", "proxy", "alpha"),
        make_identity("jane", "pilot", "alpha*"),
    )
    assert there.expires == NOW + timedelta(days=30)


def test_no_two_connections_share_secrets(rings: dict[str, KeyRing]) -> None:
    offer = Agreement(rings["jane"], *TERMS).offer()
    (_, one), (_, other) = (Agreement(rings["alpha"], *TERMS).answer(offer, NOW) for _ in range(2))
    assert len({one.up, one.down, other.up, other.down}) == 4


def change(proof: bytes, **what: bytes) -> bytes:
    return msgspec.msgpack.encode(msgspec.structs.replace(msgspec.msgpack.decode(proof, type=Proof), **what))


@pytest.mark.parametrize("number", range(len(TERMS)))
def test_an_offer_is_for_one_connection(rings: dict[str, KeyRing], number: int) -> None:
    offer = Agreement(rings["jane"], *TERMS).offer()
    others = [*TERMS[:number], "other", *TERMS[number + 1 :]]
    with pytest.raises(LinkError, match="does not have its key"):
        Agreement(rings["alpha"], *others).answer(offer, NOW)


@pytest.mark.parametrize("field", ["share", "signature", "certificate"])
def test_changes_by_a_man_in_the_middle_are_detected(rings: dict[str, KeyRing], field: str) -> None:
    """His own share, another signature, or another's certificate, in either end's message."""
    app = Agreement(rings["jane"], *TERMS)
    offer = app.offer()
    other = msgspec.msgpack.decode(Agreement(rings["eve"], *TERMS).offer(), type=Proof)
    what = {field: getattr(other, field)}
    with pytest.raises(LinkError):
        Agreement(rings["alpha"], *TERMS).answer(change(offer, **what), NOW)
    answer, _ = Agreement(rings["alpha"], *TERMS).answer(offer, NOW)
    with pytest.raises(LinkError):
        app.accept(change(answer, **what), NOW)


def test_an_answer_is_to_one_offer(rings: dict[str, KeyRing]) -> None:
    answer, _ = Agreement(rings["alpha"], *TERMS).answer(Agreement(rings["jane"], *TERMS).offer(), NOW)
    later = Agreement(rings["jane"], *TERMS)
    later.offer()
    with pytest.raises(LinkError, match="does not have its key"):
        later.accept(answer, NOW)


def test_revoked_expired_and_foreign_identities_are_refused(
    rings: dict[str, KeyRing], lab: Lab, tmp_path: Path
) -> None:
    offer = Agreement(rings["eve"], *TERMS).offer()
    proxy = Agreement(rings["alpha"], *TERMS)
    proxy.answer(offer, NOW)
    with pytest.raises(LinkError, match="expired"):
        proxy.answer(offer, NOW + timedelta(days=31))
    other = Lab.make(tmp_path / "other", now=NOW)
    other.issue(make_identity("eve", "pilot", "*"), now=NOW)
    stranger = KeyRing(load(other.folder("eve"), now=NOW))
    with pytest.raises(LinkError, match="no key of this lab"):
        proxy.answer(Agreement(stranger, *TERMS).offer(), NOW)
    lab.revoke("eve")
    rings["alpha"].refresh()
    with pytest.raises(LinkError, match=r"roster \(number 5\) does not have eve, pilot of \*"):
        proxy.answer(offer, NOW)


@pytest.mark.parametrize(
    "garbage", [b"", b"\xc0", b"\x93\xc4\x00\xc4\x00\xc4\x00", bytes(100), msgspec.msgpack.encode([b"x" * 500] * 3)]
)
def test_garbage_is_not_a_proof(rings: dict[str, KeyRing], garbage: bytes) -> None:
    with pytest.raises(LinkError):
        Agreement(rings["alpha"], *TERMS).answer(garbage, NOW)


def test_a_share_without_a_secret_is_refused(rings: dict[str, KeyRing]) -> None:
    """The points of small order: everybody would know the secret."""
    app = Agreement(rings["jane"], *TERMS)
    app._share = bytes(32)
    with pytest.raises(LinkError, match="key share is invalid"):
        Agreement(rings["alpha"], *TERMS).answer(app.offer(), NOW)


def test_messages_wait_until_they_are_polled(rings: dict[str, KeyRing], lab: Lab) -> None:
    ring = rings["alpha"]
    assert ring.admits(make_identity("eve", "pilot", "*"))
    assert not ring.admits(make_identity("eve", "pilot", "alpha")), "other rights are another identity"
    lab.revoke("eve")
    ring.refresh()
    ring.refresh()
    assert not ring.admits(make_identity("eve", "pilot", "*"))
    assert ring.outdated
    (news,) = ring.poll(NOW)
    assert "revoked or changed: eve" in news
    assert ring.poll(NOW) == []
