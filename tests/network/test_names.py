"""Finding proxies on the network: by name, all of them, two of one name, none."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
import zenoh

from skyloop.errors import LinkError, NameTakenError, UnknownNameError, UsageError
from skyloop.network import (
    FabricServer,
    FabricSettings,
    dial,
    discovery,
    layout,
    list_proxies,
    packets,
    session,
)
from skyloop.network.config import Part, free_port
from skyloop.network.discovery import renew
from skyloop.transport.base import FEEDBACK, Dialer
from skyloop.transport.testing import ClientLog, ServerLog, wait_until
from tests.network.stranger import stranger

LOCAL = "127.0.0.1"


def place() -> str:
    return f"{LOCAL}:{free_port(LOCAL)}"


def calling(*places: str) -> FabricSettings:
    return FabricSettings(connect=places, multicast=False)


@contextmanager
def serving(name: str, at: str, *, knows: tuple[str, ...] = ()) -> Iterator[tuple[FabricServer, ServerLog]]:
    settings = FabricSettings(listen=(at,), connect=knows, multicast=False)
    server, log = FabricServer(name, settings, vehicle=f"fake://{name}"), ServerLog()
    server.start(log)
    try:
        yield server, log
    finally:
        server.stop()


def test_all_proxies_are_listed_with_their_descriptions() -> None:
    one, two = place(), place()
    with serving("bravo", one), serving("alpha", two):
        found = list_proxies(calling(one, two))
        assert [(about.name, about.vehicle, about.pid) for about in found] == [
            ("alpha", "fake://alpha", os.getpid()),
            ("bravo", "fake://bravo", os.getpid()),
        ]
        assert two in found[0].address
        assert found[0].host
    assert list_proxies(calling(one, two)) == []


def test_a_name_in_use_on_the_network_is_refused_with_its_owner() -> None:
    at = place()
    with serving("alpha", at):
        second = FabricServer("alpha", FabricSettings(listen=(place(),), connect=(at,), multicast=False))
        with pytest.raises(NameTakenError, match=rf"fake://alpha on .* \(pid {os.getpid()}\)"):
            second.start(ServerLog())
        second.stop()
    with serving("alpha", at):
        pass  # free again


def test_the_older_of_two_with_one_name_keeps_it() -> None:
    """The network was split when they started."""
    one, two = place(), place()
    with serving("alpha", one) as (_, older), serving("alpha", two) as (_, younger):
        assert [about.address for about in discovery.ask(calling(one, two), "alpha")] == [
            f"fabric:alpha ({one})",
            f"fabric:alpha ({two})",
        ]
        log = ClientLog()
        client = dial("alpha", calling(two, one))(log)
        wait_until(lambda: older.joined, "it joined the older one")
        assert client.send(b"x")
        wait_until(lambda: older.packets, "it arrived there")
        assert younger.joined == []
        client.close()


def test_an_unknown_name_is_reported_with_the_searched_network_and_the_known_names() -> None:
    at = place()
    said = rf"named 'alfa' on the network \({at}\); did you mean 'alpha'"
    with serving("alpha", at), pytest.raises(UnknownNameError, match=said):
        dial("alfa", calling(at), find_s=0.3)(ClientLog())
    with pytest.raises(UsageError, match="cannot be the name"):
        dial("Alpha", calling(at))
    with pytest.raises(UsageError, match="cannot be the name"):
        FabricServer("a/b")


def test_a_proxy_that_appears_during_the_search_is_found() -> None:
    at = place()
    with ExitStack() as ends:
        dialer = dial("alpha", calling(at), find_s=5.0)
        log = ClientLog()
        ends.enter_context(serving("alpha", at))
        client = dialer(log)
        ends.callback(client.close)
        assert client.same_clock is False
        assert client.variants is True
        assert "fabric:alpha on" in client.address


def test_a_full_proxy_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.network.registry.MAX_CLIENTS", 1)
    at = place()
    with serving("alpha", at) as (_, log):
        dialer: Dialer = dial("alpha", calling(at))
        client = dialer(ClientLog())
        wait_until(lambda: log.joined, "the first is in")
        with pytest.raises(LinkError, match="already has its maximum of 1 connections"):
            dialer(ClientLog())
        client.close()
        wait_until(lambda: log.left, "it left")
        dialer(ClientLog()).close()


def test_an_applications_subscriptions_are_limited() -> None:
    at = place()
    with serving("alpha", at) as (server, log):
        client = dial("alpha", calling(at))(ClientLog())
        for number in range(70):
            client.subscribe(f"topic {number}")
        wait_until(lambda: len(log.complaints) == 6, "further ones are refused like garbage")
        assert server.subscribers("topic 63") == 1
        assert server.subscribers("topic 64") == 0
        client.close()


def test_a_server_is_started_once() -> None:
    with serving("alpha", place()) as (server, log), pytest.raises(UsageError, match="started before"):
        server.start(log)


def test_an_address_in_use_is_a_link_error() -> None:
    at = place()
    with serving("alpha", at), pytest.raises(LinkError, match="cannot join the network"):
        FabricServer("bravo", FabricSettings(listen=(at, place()), multicast=False)).start(ServerLog())


def test_several_proxies_of_one_process_share_an_address() -> None:
    at = place()
    with serving("alpha", at), serving("bravo", at):
        assert [about.name for about in list_proxies(calling(at))] == ["alpha", "bravo"]


def test_sessions_are_shared_and_end_without_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "LINGER_S", 0.05)
    settings = calling(place())
    one, two = session.acquire(settings, Part.APP), session.acquire(settings, Part.APP)
    assert one is two
    session.retire(one)
    fresh = session.acquire(settings, Part.APP)
    assert fresh is not one
    assert renew(fresh) is False, "there is no multicast to search with"
    for each in (one, two, fresh):
        session.release(each)
    wait_until(one.zenoh.is_closed, "the retired one ended")
    wait_until(fresh.zenoh.is_closed, "the other one ended after a while")


def test_a_connection_is_notified_when_its_proxy_stops_and_can_be_made_again() -> None:
    at = place()
    log = ClientLog()
    with serving("alpha", at):
        client = dial("alpha", calling(at))(log)
    wait_until(lambda: log.closings, "it was notified")
    assert log.closings == ["the proxy stopped"]
    assert not client.send(b"x")
    with serving("alpha", at) as (server, _):
        again = ClientLog()
        client = dial("alpha", calling(at), find_s=5.0)(again)
        client.subscribe(FEEDBACK)
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "it is subscribed")
        server.publish(FEEDBACK, b"f")
        wait_until(lambda: again.packets == [b"f"], "it is served")
        client.close()


def test_invalid_answers_are_not_proxies() -> None:
    """Another node on the network answers for proxies, with a token that no proxy has."""
    at, lair = place(), place()
    about = packets.ProxyInfo("bravo", layout.new_id(), 1, "there", 1, "fake://bravo", "nowhere")
    with serving("alpha", at), ExitStack() as ends:
        other = stranger(listen=[f"tcp/{lair}"], connect=[f"tcp/{at}"])
        ends.callback(other.close)

        def answer(name: str, payload: bytes) -> None:
            queryable = other.declare_queryable(layout.info(name), lambda query: query.reply(query.key_expr, payload))
            ends.callback(queryable.undeclare)

        def refuse(query: zenoh.Query) -> None:
            query.reply_err(b"no")

        answer("charlie", b"\xc1 no MessagePack")
        answer("delta", packets.encode_own(about))  # with another name
        ends.callback(other.declare_queryable(layout.info("echo"), refuse).undeclare)
        for rest in ("alpha/alive/zz", "-/alive/0123456789abcdef"):
            ends.callback(other.liveliness().declare_token(f"{layout.ROOT}/{rest}").undeclare)
        asked = session.acquire(calling(at, lair), Part.APP)
        ends.callback(session.release, asked)
        wait_until(lambda: len(list(asked.zenoh.info.peers_zid())) == 2, "it is connected to both")
        wait_until(lambda: [a.name for a in discovery.oldest_first(asked, "*")] == ["alpha"], "only the proxy is found")
        for name in ("charlie", "delta", "echo"):
            assert discovery.oldest_first(asked, name) == []
        assert {name for name, _ in discovery.runs(asked)} == {"alpha"}
