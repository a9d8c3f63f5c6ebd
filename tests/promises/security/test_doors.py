"""Admission to connections, refusals by the proxy's own end, and the immediate effects of a newer roster."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from skyloop.errors import LinkError, UnknownNameError, UsageError
from skyloop.messages import (
    AnyRequest,
    Command,
    EmergencyStop,
    EventKind,
    Hover,
    Refusal,
    RequestAuthority,
    SetParameter,
    Velocity,
    encode,
)
from skyloop.network import FabricServer, FabricSettings, layout
from skyloop.network import dial as fabric_dial
from skyloop.network.config import free_port
from skyloop.network.keys import Lab
from skyloop.network.keys.identity import access_control, make_identity
from skyloop.transport.base import COMMANDS
from skyloop.transport.testing import ClientLog, wait_until
from tests.promises.security.rig import DRONE, Intruder, Rig, keys_of, make_lab, third_party

SHORT_MS = 700


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return make_lab(tmp_path_factory.mktemp("lab") / "lab")


@pytest.fixture(scope="module")
def other_lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """A different authority, which issues the same names."""
    return make_lab(tmp_path_factory.mktemp("other") / "lab")


@pytest.fixture(scope="module")
def rig(lab: Lab) -> Iterator[Rig]:
    with Rig(lab.folder) as rig:
        yield rig


# Connecting ----------------------------------------------------------------------------------------------------


def test_a_key_of_this_lab_connects(rig: Rig, lab: Lab) -> None:
    """The baseline for the tests below."""
    third_party(rig.endpoint, lab.folder("olga"), timeout_ms=SHORT_MS).close()


@pytest.mark.parametrize("scheme", ["quic", "quic-mixed", "tls", "tcp", "udp"])
def test_a_client_without_a_key_does_not_connect(rig: Rig, lab: Lab, scheme: str) -> None:
    endpoint = rig.endpoint if scheme == "quic-mixed" else f"{scheme}/{rig.place}"
    with pytest.raises(zenoh.ZError):
        third_party(endpoint, None, authority=lab.folder("olga") / "ca.pem", timeout_ms=SHORT_MS)


def test_a_key_of_another_authority_does_not_connect(rig: Rig, lab: Lab, other_lab: Lab) -> None:
    """Neither with its own authority, nor with this lab's as the one to trust."""
    for authority in (None, lab.folder("jane") / "ca.pem"):
        with pytest.raises(zenoh.ZError):
            third_party(rig.endpoint, other_lab.folder("jane"), authority=authority, timeout_ms=SHORT_MS)


def test_an_expired_key_does_not_connect(rig: Rig, lab: Lab) -> None:
    with pytest.raises(zenoh.ZError):
        third_party(rig.endpoint, lab.folder("old"), timeout_ms=SHORT_MS)


def test_anothers_certificate_without_its_key_does_not_connect(rig: Rig, lab: Lab, tmp_path: Path) -> None:
    mixed = keys_of(lab, "olga", tmp_path)
    (mixed / "identity.pem").write_bytes((lab.folder("jane") / "identity.pem").read_bytes())
    with pytest.raises(zenoh.ZError):
        third_party(rig.endpoint, mixed, timeout_ms=SHORT_MS)


def test_a_link_ends_with_its_key(tmp_path: Path) -> None:
    lab = make_lab(tmp_path / "lab")
    with Rig(lab.folder) as rig:
        lab.issue(make_identity("olga", "observer"), days=2.5 / 86400)  # a certificate counts whole seconds
        session = third_party(rig.endpoint, lab.folder("olga"))
        try:
            assert session.info.links()
            wait_until(lambda: not session.info.links(), "the link is closed")
        finally:
            session.close()


@pytest.mark.parametrize("who", ["kim", "olga"])
def test_no_one_connects_to_a_pilot_or_an_observer_that_poses_as_a_proxy(lab: Lab, who: str) -> None:
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    config = zenoh.Config()
    folder = lab.folder(who)
    wishes = {
        "mode": "peer",
        "listen/endpoints": [f"quic/{place}?mixed_rel=1"],
        "scouting/multicast/enabled": False,
        "transport/link/tls": {
            "root_ca_certificate": str(folder / "ca.pem"),
            "listen_certificate": str(folder / "identity.pem"),
            "listen_private_key": str(folder / "identity.key"),
            "enable_mtls": True,
        },
    }
    for path, value in wishes.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config), pytest.raises(zenoh.ZError):
        third_party(f"quic/{place}?mixed_rel=1", lab.folder("jane"), timeout_ms=SHORT_MS)


def test_another_drones_proxy_that_listens_as_this_one_is_not_found(lab: Lab, tmp_path: Path) -> None:
    """By a stranger's program with the keys of bravo: our own end would refuse to serve the name."""
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    config = zenoh.Config()
    folder = lab.folder("bravo")
    wishes = {
        "mode": "peer",
        "listen/endpoints": [f"quic/{place}?mixed_rel=1"],
        "scouting/multicast/enabled": False,
        "transport/link/tls": {
            "root_ca_certificate": str(folder / "ca.pem"),
            "listen_certificate": str(folder / "identity.pem"),
            "listen_private_key": str(folder / "identity.key"),
            "enable_mtls": True,
        },
    }
    for path, value in wishes.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        held = [session.liveliness().declare_token(layout.alive(name, "f" * 16)) for name in ("alpha", "bravo")]
        jane = Rig(lab.folder).settings("jane")
        settings = FabricSettings(
            connect=(place,), multicast=False, tls=jane.tls, who="jane", access_control=jane.access_control
        )
        with pytest.raises(UnknownNameError, match="bravo"):  # which it may be, and so is the one that is known
            fabric_dial("alpha", settings, find_s=0.6)(ClientLog())
        assert held


# What the proxy's own end refuses ------------------------------------------------------------------------------


@pytest.fixture
def joined(rig: Rig) -> Iterator[Callable[[str], Intruder]]:
    """Intruders with the connections they are allowed, under their own names."""
    there: list[Intruder] = []

    def join(who: str) -> Intruder:
        intruder = rig.intruder(who)
        there.append(intruder)
        assert intruder.join()
        wait_until(lambda: intruder.got, "it is greeted")
        return intruder

    yield join
    for intruder in there:
        intruder.close()


ORDERS: dict[str, Callable[[Rig], Command]] = {
    "command": lambda rig: Command(10**6, rig.jane.lease, 10**6, rig.bench.clock(), Velocity(0.222)),
    "emergency-stop": lambda rig: Command(10**6, 0, 1, rig.bench.clock(), EmergencyStop()),
}
REQUESTS: dict[str, Callable[[Rig], AnyRequest]] = {
    "authority": lambda _: RequestAuthority(0),
    "parameter": lambda rig: SetParameter("limits.tilt", 0.0567, rig.jane.lease),
}


@pytest.mark.parametrize("what", [*ORDERS, *REQUESTS])
@pytest.mark.parametrize("who", ["olga", "bob", "kim"])
def test_a_command_sent_by_the_key_for_queries_is_refused_and_reported(
    rig: Rig, joined: Callable[[str], Intruder], who: str, what: str
) -> None:
    """The one key by which an observer reaches the proxy carries no commands, whoever uses it."""
    intruder = joined(who)
    before = len(rig.bench.published(EventKind.COMMAND_REFUSED))
    told, holder = list(rig.bench.driver.told), rig.bench.proxy.handler.authority.holder
    if what in ORDERS:
        intruder.send(layout.ASK, ORDERS[what](rig))
    else:
        intruder.request(layout.ASK, REQUESTS[what](rig))
    wait_until(lambda: len(rig.bench.published(EventKind.COMMAND_REFUSED)) > before, "the refusal is told")
    event = rig.bench.published(EventKind.COMMAND_REFUSED)[before]
    assert (event.app, event.data["reason"]) == ("intruder", Refusal.OBSERVER)
    assert rig.bench.driver.told == told
    assert rig.bench.proxy.handler.authority.holder is holder
    assert rig.bench.proxy.parameters.get("limits.tilt").value != 0.0567


def test_recorded_bytes_by_another_pilots_own_connection_are_refused_and_reported(
    rig: Rig, joined: Callable[[str], Intruder]
) -> None:
    kim = joined("kim")
    before = len(rig.bench.published(EventKind.COMMAND_REFUSED))
    told = list(rig.bench.driver.told)
    kim.send(layout.COMMAND, Command(10**6, rig.jane.lease, 10**6, rig.bench.clock(), Velocity(0.222)))
    wait_until(lambda: len(rig.bench.published(EventKind.COMMAND_REFUSED)) > before, "the refusal is told")
    assert rig.bench.published(EventKind.COMMAND_REFUSED)[before].data["reason"] == Refusal.NO_AUTHORITY
    assert rig.bench.driver.told == told


def test_commands_of_a_connection_that_never_existed_are_refused_and_reported(rig: Rig) -> None:
    before = len(rig.bench.published(EventKind.COMMAND_REFUSED))
    told = list(rig.bench.driver.told)
    kim = rig.intruder("kim")

    def refused() -> bool:
        kim.send(layout.COMMAND, Command(10**6, rig.jane.lease, 10**6, rig.bench.clock(), Velocity(0.222)))
        time.sleep(0.01)
        return len(rig.bench.published(EventKind.COMMAND_REFUSED)) > before

    wait_until(refused, "the refusal is told")
    kim.close()
    event = rig.bench.published(EventKind.COMMAND_REFUSED)[before]
    assert (event.app, event.data["reason"]) == (None, Refusal.PROTOCOL)
    assert "applications that are not connected" in event.text
    assert rig.bench.driver.told == told


# What a newer roster changes at once ---------------------------------------------------------------------------


def test_a_client_revoked_in_flight_loses_the_drone_and_does_not_come_back(tmp_path: Path) -> None:
    lab = make_lab(tmp_path / "lab")
    with Rig(lab.folder) as rig:
        ring = rig.server._settings.ring
        assert ring is not None
        jane, jane_settings = rig.jane, rig.settings("jane")
        lab.revoke("jane")
        (news,) = ring.poll()
        assert "revoked or changed: jane" in news

        def ended() -> bool:
            jane.end.send(encode(ORDERS["command"](rig)))  # False once it is disconnected
            time.sleep(0.01)
            return not jane.closed_by.empty()

        wait_until(ended, "jane is disconnected")
        assert "revoked" in jane.closed_by.get()
        wait_until(lambda: rig.bench.driver.told == [Hover()], "the vehicle hovers, as when any pilot is gone")
        with pytest.raises(LinkError, match="revoked"):
            fabric_dial(DRONE, jane_settings)(ClientLog())


# Which keys our own ends take ----------------------------------------------------------------------------------


def test_our_ends_refuse_keys_of_another_role_or_name(rig: Rig, lab: Lab) -> None:
    with pytest.raises(UsageError, match="a proxy needs keys created with --role proxy"):
        FabricServer(DRONE, rig.settings("jane"))
    with pytest.raises(UsageError, match="not for the name 'alpha'"):
        FabricServer(DRONE, rig.settings("bravo"))
    for who in ("alpha", "hub"):
        with pytest.raises(UsageError, match="an application needs"):
            fabric_dial(DRONE, rig.settings(who))


def test_the_echoes_of_commands_are_seen_by_observers(rig: Rig) -> None:
    """Not a secret: commands of others are published, as on one host; only the original commands can't be read."""
    olga = rig.intruder("olga")
    olga.see()
    olga.listen(layout.topic(DRONE, COMMANDS))

    def seen() -> bool:
        rig.jane.command(Velocity(0.1))
        return bool(olga.got)

    wait_until(seen, "an echo is seen")
    olga.close()


# Through a router ----------------------------------------------------------------------------------------------


def test_a_router_applies_the_rules_to_those_who_connect_to_it(lab: Lab) -> None:
    """It forwards a pilot's command, but not an observer's or one in another's name; the proxy trusts the router."""
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    endpoint = f"quic/{place}?mixed_rel=1"
    identities = [entry.identity for entry in lab.roster.entries]

    def node(who: str, mode: str, where: str) -> zenoh.Session:
        config, folder = zenoh.Config(), lab.folder(who)
        certificate, key = str(folder / "identity.pem"), str(folder / "identity.key")
        wishes = {
            "mode": mode,
            f"{where}/endpoints": [endpoint],
            "scouting/multicast/enabled": False,
            "transport/link/tls": {
                "root_ca_certificate": str(folder / "ca.pem"),
                "listen_certificate": certificate,
                "listen_private_key": key,
                "connect_certificate": certificate,
                "connect_private_key": key,
                "enable_mtls": True,
                "verify_name_on_connect": False,
            },
            "access_control": access_control(identities),
        }
        if where == "connect":
            wishes["listen/endpoints"] = []
        for path, value in wishes.items():
            config.insert_json5(path, json.dumps(value))
        return zenoh.open(config)

    heard: list[tuple[str, bytes]] = []
    with node("hub", "router", "listen"), node("alpha", "peer", "connect") as alpha:
        for way in (layout.COMMAND, layout.ORDER, layout.ASK):  # known to the others in this order
            alpha.declare_subscriber(
                layout.upward(way, DRONE, "*", "*"),
                lambda sample: heard.append((str(sample.key_expr), sample.payload.to_bytes())),
            )
        passed = {}
        for who in ("kim", "olga", "bob"):
            keys = [layout.upward(way, DRONE, who, "0" * 16) for way in (layout.COMMAND, layout.ORDER, layout.ASK)]
            false = layout.upward(layout.COMMAND, DRONE, "jane", "0" * 16)
            with third_party(endpoint, lab.folder(who), mode="client") as session:

                def asked(word: bytes) -> bool:
                    for key in (false, *keys):  # noqa: B023  called at once
                        session.put(key, word)
                    return (keys[-1], word) in heard  # noqa: B023  put last, so that the others would have arrived before

                wait_until(lambda: asked(b"first"), "a question arrives")
                # By now it knows the subscribers: before, a command may have been lost, but not a question.
                wait_until(lambda: asked(b"then"), "and another one")
            passed[who] = {key for key, _ in heard if key in (false, *keys)}
    mine = {who: {layout.upward(way, DRONE, who, "0" * 16) for way in ("command", "order", "ask")} for who in passed}
    assert passed == {
        "kim": mine["kim"],
        "olga": {layout.upward("ask", DRONE, "olga", "0" * 16)},
        "bob": {layout.upward("ask", DRONE, "bob", "0" * 16)},
    }
