"""A drone on the network with its rightful users, and an intruder with Zenoh's plain API."""

from __future__ import annotations

import itertools
import json
import struct
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any

import zenoh

from skyloop.errors import DecodeError
from skyloop.messages import AnyRequest, Hello, Request, Role, Sample, encode
from skyloop.network import FabricServer, FabricSettings, layout, packets
from skyloop.network import dial as fabric_dial
from skyloop.network.admission import Admission, JoinRequest
from skyloop.network.client import FabricClient
from skyloop.network.config import free_port, secured
from skyloop.network.keys import KeyRing, Lab, load
from skyloop.network.keys.identity import make_identity
from skyloop.network.sealing import Open
from skyloop.transport.base import Dialer
from tests.support.proxy_bench import App, Bench

DRONE = "alpha"
ANSWER_S = 0.3
NOW = datetime.now(UTC)
_NUMBERS = itertools.count(10**6)


def make_lab(directory: Path) -> Lab:
    """Jane flies alpha while Wendy observes; the others have keys too, but not for what they will try."""
    lab = Lab.make(directory, now=NOW - timedelta(days=40))
    for name, role, drones in (
        ("alpha", "proxy", "alpha"),
        ("bravo", "proxy", "bravo"),
        ("jane", "pilot", "alpha*"),
        ("wendy", "observer", "*"),
        ("kim", "pilot", "alpha"),
        ("bob", "pilot", "bravo,charlie*"),
        ("olga", "observer", "*"),
        ("oscar", "observer", "bravo"),
        ("eve", "pilot", "*"),
        ("hub", "router", "*"),
    ):
        lab.issue(make_identity(name, role, drones), now=NOW)
    lab.issue(make_identity("old", "pilot"), now=NOW - timedelta(days=35))
    return lab


def keys_of(lab: Lab, name: str, directory: Path) -> Path:
    """A copy of an identity's folder, as its holder has it."""
    copy = directory / name
    copy.mkdir(mode=0o700, parents=True, exist_ok=True)
    for file in lab.folder(name).iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    (copy / "identity.key").chmod(0o600)
    return copy


class Rig:
    """A proxy named ``alpha`` with a fake vehicle, jane who flies it, and wendy who observes. ``keys`` is None for a
    network without keys, where everyone is called ``anyone``. ``routed``: applications were given a router's address,
    too."""

    def __init__(self, keys: Callable[[str], Path] | None, *, routed: bool = False) -> None:
        self._keys = keys
        self.place = f"127.0.0.1:{free_port('127.0.0.1')}"
        #: The address by which applications reach the intruder: without keys any peer they find, with keys a router.
        self.lair = f"127.0.0.1:{free_port('127.0.0.1')}" if keys is None or routed else ""
        self.frames = 0  #: number of published frames
        self._ends = ExitStack()

    def __enter__(self) -> Rig:
        server = FabricServer(DRONE, self._settings("alpha", listen=(self.place,)))
        self.bench = self._ends.enter_context(Bench(transport=(server, self.dialer("jane"))))
        self.server = server
        self.jane = self.bench.pilot("jane")
        self.bench.take_off(self.jane)
        self.bench.dial = self.dialer("wendy")
        self.wendy = self.bench.join("wendy", Role.OBSERVER)
        self.wendy.end.subscribe("video/front")
        self.wendy.sync()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ends.__exit__(kind, error, trace)

    def _settings(self, who: str, **where: Any) -> FabricSettings:
        settings = FabricSettings(multicast=False, **where)
        return settings if self._keys is None else secured(settings, load(self._keys(who)))

    def settings(self, who: str) -> FabricSettings:
        """The settings of an application."""
        return self._settings(who, connect=(self.place, self.lair) if self.lair else (self.place,))

    def dialer(self, who: str) -> Dialer:
        return fabric_dial(DRONE, self.settings(who))

    @property
    def endpoint(self) -> str:
        return self._endpoint(self.place)

    def _endpoint(self, place: str) -> str:
        return f"tcp/{place}" if self._keys is None else f"quic/{place}?mixed_rel=1"

    def who(self, name: str) -> str:
        """The name by which this network knows a user."""
        return "anyone" if self._keys is None else name

    def connection_of(self, app: App) -> str:
        """The connection's id, which an eavesdropper would have to know."""
        assert isinstance(app.end, FabricClient)
        return app.end._id

    def run_bytes(self) -> bytes:
        return bytes.fromhex(self.server._run)

    def intruder(self, name: str) -> Intruder:
        """An intruder linked to the proxy, and to the applications where they call. It ends with this rig."""
        keys = None if self._keys is None else self._keys(name)
        listen = (self._endpoint(self.lair),) if self.lair else ()
        somebody = Intruder(third_party(self.endpoint, keys, listen=listen), self.who(name), self, keys)
        self._ends.callback(somebody.close)
        return somebody


def third_party(
    endpoint: str,
    keys: Path | None,
    *,
    authority: Path | None = None,
    timeout_ms: int = 3000,
    mode: str = "peer",
    listen: tuple[str, ...] = (),
) -> Any:
    """A session of the plain API with any configuration; raises ``zenoh.ZError`` if nothing answers."""
    config = zenoh.Config()
    tls: dict[str, Any] = {"enable_mtls": True, "verify_name_on_connect": False}
    if keys is not None:
        certificate, key = str(keys / "identity.pem"), str(keys / "identity.key")
        tls |= {
            f"{end}_{part}": file
            for end in ("connect", "listen")
            for part, file in (("certificate", certificate), ("private_key", key))
        }
        authority = authority or keys / "ca.pem"
    else:
        tls["enable_mtls"] = False
    if authority is not None:
        tls["root_ca_certificate"] = str(authority)
    wishes = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": timeout_ms,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "transport/link/tls": tls,
    }
    for path, value in wishes.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


class Intruder:
    """An intruder with a session of the plain API, who knows the documented layout of keys, packets and seals.

    ``got`` holds the data it could read.
    """

    def __init__(self, session: Any, who: str, rig: Rig, keys: Path | None = None) -> None:
        self.session = session
        self.who = who
        self.rig = rig
        self.id = layout.new_id()
        self.got: list[tuple[str, bytes]] = []
        self.held: list[Any] = []
        self.ring = None if keys is None else KeyRing(load(keys))
        self.admission = Admission()  #: with keys: how the proxy admitted it, if it did

    def close(self) -> None:
        if not self.session.is_closed():
            self.session.close()

    def put(self, key: str, packet: bytes, attachment: bytes = bytes(8)) -> None:
        """Send by both links. A put without a publisher is sent whether or not this end knows of a subscriber, so only
        the other end can keep it from arriving."""
        packet, attachment = self.seal(key, packet, attachment)
        self.session.put(key, packet, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)
        publisher = self.session.declare_publisher(key, reliability=zenoh.Reliability.BEST_EFFORT)
        publisher.put(packet, attachment=attachment)
        self.held.append(publisher)

    def seal(self, key: str, packet: bytes, attachment: bytes) -> tuple[bytes, bytes]:
        """Packet and attachment as a holder of these keys seals them: for its own connection, and for published data
        with the key of all who may see the drone."""
        if self.id in key:
            return self.admission.sealer.seal(key, attachment, packet)
        if isinstance(self.admission.topics, Open) and ("/topic/" in key or "/video/" in key):
            generation, cipher = max(self.admission.topics._ciphers.items())
            attachment += struct.pack("<IQ", generation, next(_NUMBERS))
            return cipher.encrypt(attachment[-12:], packet, key.encode() + b"\0" + attachment), attachment
        return packet, attachment

    def send(self, way: str, sample: Sample, *, who: str | None = None, connection: str | None = None) -> None:
        """Send as an application, with its own key or another user's."""
        key = layout.upward(way, DRONE, who or self.who, connection or self.id)
        self.put(key, encode(sample))

    def request(self, way: str, body: AnyRequest, **to: str) -> None:
        self.send(way, Request(7, body), **to)

    def listen(self, key: str) -> None:
        def heard(sample: Any) -> None:
            where, admission = str(sample.key_expr), self.admission
            opener = admission.opener if f"/to/{self.id}" in where else admission.topics
            if self.ring is None or admission.offer:
                try:
                    opened = opener.open(where, bytes(sample.attachment or b""), bytes(sample.payload))
                except DecodeError:
                    return
                if opened is not None:
                    self.got.append((where, opened[0]))

        self.held.append(self.session.declare_subscriber(key, heard))

    def ask(self, key: str, payload: bytes = b"") -> list[bytes]:
        """The answers to a query."""
        replies = self.session.get(key, payload=payload, target=zenoh.QueryTarget.ALL, timeout=ANSWER_S)
        return [bytes(reply.ok.payload) for reply in replies if reply.ok is not None]

    def join(self, who: str | None = None) -> bool:
        """Open a connection, with its token, as the key layout requires; return whether the proxy agreed."""
        who = who or self.who
        self.listen(layout.to(DRONE, self.id))
        self.held.append(self.session.liveliness().declare_token(layout.app(DRONE, who, self.id)))
        request = JoinRequest(self.ring, DRONE, self.rig.server._run, layout.Sender("join", who, self.id))
        wish = packets.encode_own(packets.Join(packets.REVISION, self.rig.server._run, proof=request.proof))
        for welcome in self.ask(layout.join(DRONE, who, self.id), wish):
            self.admission = request.accept(packets.decode_welcome(welcome))
            self.request(layout.ASK, Hello("intruder", Role.PILOT), who=who)
            return True
        return False

    def see(self) -> None:
        """Subscribe to everything published, if these keys allow it."""
        if self.ring is not None and not self.admission.offer:
            self.join()
