"""Keys that are revoked at run time, and the powers of a router's key. By whichever path the newer roster arrived,
connections end, no one new is admitted, and nothing more can be read."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from skyloop.errors import SkyloopError, UnknownNameError
from skyloop.messages import Command, EmergencyStop, Velocity, encode
from skyloop.messages.codec import SIGNATURE
from skyloop.network import FabricSettings, layout, packets, sealing
from skyloop.network import dial as fabric_dial
from skyloop.network.config import Part, free_port, secured
from skyloop.network.discovery import runs
from skyloop.network.keys import Lab, load
from skyloop.network.session import FabricSession, acquire, release, renewed
from skyloop.transport.base import FEEDBACK
from skyloop.transport.testing import ClientLog, wait_until
from tests.promises.security.deeds import DEEDS, WORKS, comes_true
from tests.promises.security.rig import DRONE, Rig, keys_of, make_lab

HARM = [deed for deed in DEEDS if "hub" not in WORKS.get(deed.what, ())]


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return make_lab(tmp_path / "lab")


@pytest.fixture
def kept(lab: Lab, tmp_path: Path) -> Callable[[str], Path]:
    """Everyone's keys; the revoked user's as a thief has copied them."""
    stolen = {name: keys_of(lab, name, tmp_path / "stolen") for name in ("alpha", "hub", "olga", "eve")}
    return lambda name: stolen[name] if name in ("hub", "olga", "eve") else lab.folder(name)


@pytest.fixture
def rig(kept: Callable[[str], Path]) -> Iterator[Rig]:
    with Rig(kept) as rig:
        yield rig


@pytest.fixture
def routed(kept: Callable[[str], Path]) -> Iterator[Rig]:
    with Rig(kept, routed=True) as rig:
        yield rig


def test_a_router_that_is_revoked_in_flight_does_no_harm(rig: Rig, lab: Lab) -> None:
    """It was linked before, and Zenoh's access control still knows it."""
    hub = rig.intruder("hub")
    lab.revoke("hub")
    for deed in HARM:
        deed.do(rig, hub)
    assert not comes_true(lambda: any(deed.done(rig, hub) for deed in HARM), 1.0)
    rig.jane.sync()
    assert [deed.what for deed in HARM if deed.done(rig, hub)] == []
    rig.jane.command(Velocity(0.3))
    assert rig.bench.driver.told[-1:] == [Velocity(0.3)], "the pilot keeps flying"
    hub.close()


def test_packets_forwarded_by_a_router_are_accepted_once_and_unchanged(routed: Rig) -> None:
    """It sees the sealed bytes. Repeated, or sent with another key or attachment, they have no effect."""
    hub, connection = routed.intruder("hub"), routed.connection_of(routed.jane)
    passing: list[tuple[str, bytes, bytes]] = []
    hub.held.append(
        hub.session.declare_subscriber(
            f"{layout.ROOT}/{DRONE}/*/jane/{connection}",
            lambda each: passing.append((str(each.key_expr), bytes(each.payload), bytes(each.attachment))),
        )
    )

    def seen() -> bool:
        routed.jane.command(Velocity(0.2))
        routed.jane.sync()
        return {key.split("/")[3] for key, _, _ in passing} == {"command", "ask"}

    wait_until(seen, "sealed packets pass by")
    recorded = list(passing)
    assert not any(payload.startswith(SIGNATURE) for _, payload, _ in recorded), "nothing can be read"
    told, answered = list(routed.bench.driver.told), routed.jane._replies.qsize()
    for key, payload, attachment in recorded:
        changed = bytes([payload[0] ^ 1]) + payload[1:]
        other = layout.upward("order" if "/ask/" in key else "ask", DRONE, "jane", connection)
        for where, what, how in (
            (key, payload, attachment),
            (key, changed, attachment),
            (other, payload, attachment),
            (key, payload, attachment[:-1] + bytes([attachment[-1] ^ 1])),
            (key, payload, b""),
        ):
            hub.session.put(where, what, attachment=how)
    before = routed.server.strays
    hub.session.put(layout.upward("ask", DRONE, "jane", connection), b"the last of it", attachment=bytes(20))
    wait_until(lambda: routed.server.strays > before, "all of it has arrived")
    routed.jane.sync()
    assert routed.bench.driver.told == told
    assert routed.jane._replies.qsize() == answered
    hub.close()


def test_a_revoked_user_reads_nothing_more_while_the_others_continue(rig: Rig, lab: Lab) -> None:
    """Its own program keeps listening, and Zenoh's access control is that of the start."""
    olga = rig.intruder("olga")
    olga.see()
    olga.listen(layout.topic(DRONE, FEEDBACK))
    olga.listen(layout.to(DRONE, "*"))

    def seen() -> bool:
        rig.bench.driver.report()
        return any("/topic/" in key for key, _ in olga.got)

    wait_until(seen, "olga sees the feedback")
    lab.revoke("olga")

    def shut() -> bool:
        return not any(each.who == "olga" for each in rig.server._registry.connections)

    wait_until(shut, "olga's connection is ended")
    bye = packets.bye("its key was revoked, or its rights were changed")
    wait_until(lambda: bye in [packet for _, packet in olga.got], "olga is told")
    time.sleep(sealing.SWITCH_S)  # data published in this time may still be read
    olga.got.clear()
    for number in range(20):
        rig.bench.driver.report(battery=0.5 + number / 100)

    def flows() -> bool:
        rig.bench.driver.report(battery=0.9)
        return any(feedback.battery == 0.9 for feedback in rig.wendy.feedback)

    wait_until(flows, "wendy sees the feedback")
    assert olga.got == []
    assert not olga.join()
    olga.close()


def test_applications_leave_a_proxy_whose_key_is_revoked(tmp_path: Path) -> None:
    """Only the application has the newer roster: the thief is on the proxy's host."""
    lab = make_lab(tmp_path / "lab")
    stolen = keys_of(lab, "alpha", tmp_path / "stolen")
    with Rig(lambda name: stolen if name == "alpha" else lab.folder(name)) as rig:
        lab.revoke("alpha")
        assert "revoked" in rig.wendy.closed_by.get(timeout=10.0)
        assert "revoked" in rig.jane.closed_by.get(timeout=10.0)
        with pytest.raises(UnknownNameError, match="alpha"):
            fabric_dial(DRONE, rig.settings("jane"), find_s=0.5)(ClientLog())


def test_no_new_connection_is_made_to_a_user_revoked_meanwhile(tmp_path: Path) -> None:
    """The dialer of a running program uses the current roster, not that of its start."""
    lab = make_lab(tmp_path / "lab")
    copies = {name: keys_of(lab, name, tmp_path / "copies") for name in ("alpha", "kim")}
    with Rig(lambda name: copies.get(name, lab.folder(name))) as rig:
        dial = rig.dialer("kim")
        dial(ClientLog()).close()
        for who, what in (("alpha", "no proxy"), ("kim", "the keys of kim were revoked")):
            lab.revoke(who)
            (copies["kim"] / "roster.json").write_bytes((lab.directory / "roster.json").read_bytes())
            with pytest.raises(SkyloopError, match=what):
                dial(ClientLog())


def test_an_application_moves_on_to_the_proxy_that_has_the_key(routed: Rig) -> None:
    """An impostor is the first to claim to be the proxy, and answers queries."""
    false = "0" * 16
    hub = routed.intruder("hub")
    key = layout.info(DRONE)
    about = packets.encode_own(packets.ProxyInfo(DRONE, false, 0, "a lie", 1, "", ""))
    hub.held.append(hub.session.liveliness().declare_token(layout.alive(DRONE, false)))
    hub.held.append(hub.session.declare_queryable(key, lambda query: query.reply(key, about)))

    def both() -> bool:
        session = acquire(routed.settings("kim"), Part.APP)
        try:
            return (DRONE, false) in runs(session)
        finally:
            release(session)

    wait_until(both, "the other one is found, too")
    log = ClientLog()
    client = fabric_dial(DRONE, routed.settings("kim"))(log)
    assert "a lie" not in client.address
    client.close()
    hub.close()


def test_a_connection_ends_with_its_key_though_a_router_lies_between(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    class Later(datetime):
        @classmethod
        def now(cls, tz: object = None) -> datetime:  # type: ignore[override]
            return datetime.now(UTC) + timedelta(days=31)

    monkeypatch.setattr("skyloop.network.registry.datetime", Later)
    assert "expired" in rig.wendy.closed_by.get(timeout=10.0)


def test_a_restarted_router_excludes_revoked_users(lab: Lab, kept: Callable[[str], Path]) -> None:
    """Other users are admitted; the revoked pilot, who was connected, is denied everything."""
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    keys = load(keys_of(lab, "hub", lab.directory / "router"))
    hub = acquire(secured(FabricSettings(listen=(place,), multicast=False), keys), Part.ROUTER)

    def join(keys: Path, part: Part) -> FabricSession:
        listen = ("127.0.0.1:0",) if part is Part.PROXY else ()
        return acquire(secured(FabricSettings(connect=(place,), listen=listen, multicast=False), load(keys)), part)

    eve = join(kept("eve"), Part.APP)
    wait_until(lambda: "eve" in hub.peers(), "eve is linked")
    ring = hub.settings.ring
    assert ring is not None
    assert hub.shut_out() == frozenset()
    lab.revoke("eve")
    (lab.directory / "router" / "hub" / "roster.json").write_bytes((lab.directory / "roster.json").read_bytes())
    ring.refresh()
    assert hub.shut_out() == {"eve"}
    hub = renewed(hub)
    assert hub.listens == [place]
    heard: list[str] = []
    alpha = join(lab.folder("alpha"), Part.PROXY)
    alpha.zenoh.declare_subscriber(
        layout.upward(layout.COMMAND, DRONE, "*", "*"), lambda sample: heard.append(str(sample.key_expr))
    )
    jane = join(lab.folder("jane"), Part.APP)

    def passes() -> bool:
        eve.zenoh.put(layout.upward(layout.COMMAND, DRONE, "eve", "0" * 16), b"x")
        jane.zenoh.put(layout.upward(layout.COMMAND, DRONE, "jane", "0" * 16), b"x")
        return bool(heard)

    wait_until(passes, "a pilot's packets pass the router again")
    assert not any("/eve/" in key for key in heard)
    for session in (eve, jane, alpha, hub):
        release(session, linger=False)


def test_commands_need_a_pilots_key_whatever_a_router_forwards(rig: Rig) -> None:
    """An observer and a router collude: the proxy checks whose connection it is."""
    olga, hub = rig.intruder("olga"), rig.intruder("hub")
    olga.see()
    key = layout.upward(layout.COMMAND, DRONE, "olga", olga.id)
    stop = encode(Command(10**6, 0, 1, rig.bench.clock(), EmergencyStop()))
    before = rig.server.refused

    def refused() -> bool:
        payload, attachment = olga.admission.sealer.seal(key, bytes(8), stop)
        hub.session.put(key, payload, attachment=attachment)
        return rig.server.refused > before

    wait_until(refused, "it is refused")
    assert EmergencyStop() not in rig.bench.driver.told
    olga.close()
    hub.close()
