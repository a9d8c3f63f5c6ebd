"""How this process joins the network: where it listens, what it connects to, and with which keys."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skyloop.errors import LinkError, UsageError
from skyloop.network.layout import ANYONE, check_identity

if TYPE_CHECKING:
    from skyloop.network.keys import Credentials, Identity, KeyRing

LEASE_S: Final = 0.7  #: without a sign of life for so long a peer is gone, if it asks for nothing else
MAX_LEASE_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """An identity for mutual TLS, as PEM files."""

    ca: Path  #: certificate of the authority that signed everybody's
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class FabricSettings:
    """How to join the network; by default others on the same network segments are found by multicast, without keys.

    ``listen`` and ``connect`` are addresses such as ``10.0.0.5:7447``, ``[::1]:0`` (any free port) or ``10.0.0.5``
    (port 7447). Without keys each stands for TCP (what must arrive) and UDP (commands and feedback), with keys for
    QUIC. An address may also be a whole Zenoh endpoint, ``tcp/10.0.0.5:7447``, which is used as it is.

    Raises:
        UsageError: The identity is not valid, or is given without its certificate and key; or the lease is none.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    multicast: bool = True  #: search, and be found, by UDP multicast on the network segments of this host
    tls: TlsFiles | None = None
    #: A link counts as lost when nothing came by it for so long [s], by the others as they are told, and by an
    #: application 0.3 s later. A mobile network is silent for seconds, and what was lost takes another to come back.
    lease_s: float = LEASE_S
    who: str = ANYONE  #: the identity: the common name of the certificate
    #: Zenoh's ``access_control`` section (https://zenoh.io/docs/manual/access-control/), None for none.
    access_control: dict[str, Any] | None = None
    #: The keys that ``tls`` and ``access_control`` were made from.
    ring: KeyRing | None = field(default=None, compare=False)

    def current(self) -> FabricSettings:
        """Return these settings with the newest roster in the folder of the keys, for a new session.

        Raises:
            LinkError: That roster revokes these keys themselves.
        """
        if self.ring is None:
            return self
        self.ring.refresh()
        credentials = self.ring.credentials
        if not self.ring.admits(credentials.identity):
            raise LinkError(f"the keys of {credentials.name} were revoked, or their rights changed: get new ones")
        if not self.ring.outdated:
            return self
        return secured(self, credentials)

    @property
    def excused_s(self) -> float:
        """By how much longer a silence is borne than usual [s]."""
        return self.lease_s - LEASE_S

    @property
    def reach(self) -> str:
        """Where proxies are searched for, for people."""
        ways = [*self.connect, *(["multicast"] if self.multicast else [])]
        return ", ".join(ways) or "nowhere"

    @property
    def identity(self) -> Identity | None:
        """Whose keys these are; None without keys."""
        return None if self.ring is None else self.ring.credentials.identity

    def __post_init__(self) -> None:
        check_identity(self.who)
        if not LEASE_S <= self.lease_s <= MAX_LEASE_S:
            raise UsageError(f"the lease is {self.lease_s!r} and must be {LEASE_S:g} to {MAX_LEASE_S:g} seconds")
        if self.tls is None and self.who != ANYONE:
            raise UsageError(f"the identity {self.who!r} needs its certificate and key")


def secured(settings: FabricSettings, credentials: Credentials) -> FabricSettings:
    """Return these settings with a key: mutual TLS over QUIC, and access control by the roster that came with it."""
    from skyloop.network.access import access_control
    from skyloop.network.keys import KeyRing  # with keys only: these need cryptography

    return replace(
        settings,
        tls=TlsFiles(credentials.authority_file, credentials.certificate_file, credentials.key_file),
        who=credentials.name,
        access_control=access_control(credentials.roster.identities),
        ring=KeyRing(credentials),
    )
