"""However many connections, tokens and bytes one key brings, the others can find the drone, connect and fly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from skyloop.errors import DecodeError
from skyloop.messages import EventKind, Velocity
from skyloop.network import layout, packets
from skyloop.network.admission import (
    FOR_PILOTS,
    MAX_CLIENTS,
    PER_KEY,
    TOKENS,
    TOKENS_PER_KEY,
    JoinRequest,
    Tokens,
    no_place_reason,
)
from skyloop.network.config import MAX_MESSAGE_UP
from skyloop.network.discovery import RUNS_PER_NAME, _oldest_of_each, list_proxies
from skyloop.transport.testing import wait_until
from tests.promises.security.rig import DRONE, Intruder, Rig, make_lab, third_party

FLOOD = 4200  #: tokens


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    return make_lab(tmp_path_factory.mktemp("keys") / "lab").folder


@pytest.fixture
def rig(keys: Callable[[str], Path]) -> Iterator[Rig]:
    with Rig(keys) as rig:
        yield rig


@pytest.fixture
def olga(rig: Rig) -> Iterator[Intruder]:
    """An observer."""
    somebody = rig.intruder("olga")
    yield somebody
    somebody.close()


def joins(rig: Rig, by: Intruder, connection: str) -> bool:
    by.held.append(by.session.liveliness().declare_token(layout.app(DRONE, by.who, connection)))
    run = rig.server._run
    request = JoinRequest(by.ring, DRONE, run, layout.Sender("join", by.who, connection))
    wish = packets.encode_own(packets.Join(packets.REVISION, run, proof=request.proof))
    replies = by.session.get(layout.join(DRONE, by.who, connection), payload=wish, timeout=5.0)
    return any(reply.ok is not None for reply in replies)


def others_get_in(rig: Rig) -> None:
    assert [about.name for about in list_proxies(rig.settings("kim"))] == [DRONE]
    rig.bench.dial = rig.dialer("kim")
    rig.bench.join("kim").sync()
    rig.jane.command(Velocity(0.1))
    assert Velocity(0.1) in rig.bench.driver.told


def test_one_key_does_not_take_all_places(rig: Rig, olga: Intruder) -> None:
    got_in = sum(joins(rig, olga, layout.new_id()) for _ in range(MAX_CLIENTS))
    assert got_in == PER_KEY
    others_get_in(rig)
    assert rig.server.counters["network.turned_away"] == MAX_CLIENTS - PER_KEY

    def told() -> list[str]:
        return [event.text for event in rig.bench.published(EventKind.COMMAND_REFUSED) if "olga" in event.text]

    wait_until(told, "it is told")
    assert f"already has {PER_KEY}" in told()[0]


def test_thousands_of_signs_of_life_hide_no_drone(rig: Rig) -> None:
    try:  # Zenoh's "clients" are no longer admitted: a peer forwarded all that they declared to everyone
        session = third_party(rig.endpoint, rig._keys("olga") if rig._keys else None, timeout_ms=1000, mode="client")
    except zenoh.ZError:
        session = rig.intruder("olga").session
    with session:
        held = [session.liveliness().declare_token(layout.app(DRONE, "olga", layout.new_id())) for _ in range(FLOOD)]
        others_get_in(rig)
        wait_until(lambda: rig.server.counters["network.turned_away"], "it is counted")
        assert len(held) == FLOOD


def test_data_larger_than_any_packet_is_never_assembled(rig: Rig, olga: Intruder) -> None:
    assert olga.join()
    key = layout.upward(layout.ASK, DRONE, "olga", olga.id)
    strays = rig.server.strays
    olga.session.put(key, bytes(2 * MAX_MESSAGE_UP), attachment=bytes(8))
    olga.session.put(key, bytes(MAX_MESSAGE_UP // 2), attachment=bytes(8))
    wait_until(lambda: rig.server.strays > strays, "the second one came, and was not taken")
    assert rig.server.strays == strays + 1
    others_get_in(rig)


class Huge:
    """Bytes that must not be copied."""

    def __len__(self) -> int:
        return 10**8

    def __bytes__(self) -> bytes:
        pytest.fail("it was copied")


class HugeSample:
    payload: Any = Huge()
    attachment: Any = None


class HugeAttachment:
    payload: Any = b"x"
    attachment: Any = Huge()


def test_oversized_data_is_refused_before_it_is_copied() -> None:
    huge: Any = Huge()
    with pytest.raises(DecodeError, match="at most 4096"):
        packets.copied(huge, packets.MAX_OWN)
    for sample in (HugeSample(), HugeAttachment()):
        as_sample: Any = sample
        with pytest.raises(DecodeError, match="100000000 bytes"):
            packets.contents(as_sample)


# --- the rules ---


def present(**counts: tuple[int, bool]) -> list[tuple[str, bool]]:
    return [(who, flies) for who, (count, flies) in counts.items() for _ in range(count)]


@pytest.mark.parametrize(
    ("who", "flies", "here", "why"),
    [
        ("olga", False, present(olga=(PER_KEY - 1, False)), ""),
        ("olga", False, present(olga=(PER_KEY, False)), "the key of 'olga' already has"),
        ("jane", True, present(jane=(PER_KEY, True)), "the key of 'jane' already has"),
        ("jane", True, present(olga=(PER_KEY, False)), ""),
        ("anna", False, present(**{f"o{n}": (PER_KEY, False) for n in range(3)}), "reserved for pilots"),
        ("jane", True, present(**{f"o{n}": (PER_KEY, False) for n in range(3)}), ""),
        ("jane", True, present(**{f"o{n}": (PER_KEY, n == 0) for n in range(4)}), f"at most {MAX_CLIENTS}"),
    ],
)
def test_the_allocation_of_connections(who: str, flies: bool, here: list[tuple[str, bool]], why: str) -> None:
    answer = no_place_reason(who, flies, here)
    assert bool(answer) == bool(why)
    assert why in answer


def test_three_keys_that_may_not_fly_leave_a_key_for_pilots_room() -> None:
    assert MAX_CLIENTS - 3 * PER_KEY == FOR_PILOTS


def test_signs_of_life_are_remembered_by_key() -> None:
    tokens = Tokens(by_key=True)
    assert sum(tokens.add("olga", str(n)) for n in range(2 * TOKENS_PER_KEY)) == TOKENS_PER_KEY
    assert tokens.add("olga", "0"), "it is already known"
    assert tokens.add("jane", "a")
    assert tokens.any_of({"a": "jane", "b": "kim"})
    assert not tokens.has("olga", "a")
    tokens.discard("jane", "a")
    tokens.discard("nobody", "a")
    assert not tokens.any_of({"a": "jane"})
    everybody = Tokens(by_key=False)
    assert sum(everybody.add("anyone", str(n)) for n in range(2 * TOKENS)) == TOKENS


def test_answering_a_thousand_times_for_one_name_hides_no_other() -> None:
    many = [packets.ProxyInfo("bravo", f"{n:016x}", n, "", 1, "", "") for n in range(1000)]
    alpha = packets.ProxyInfo("alpha", "f" * 16, 10**6, "", 1, "", "")
    assert _oldest_of_each([*reversed(many), alpha]) == [*many[:RUNS_PER_NAME], alpha]
