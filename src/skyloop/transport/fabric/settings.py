"""How this process takes part in the network: where it listens, whom it calls, and with which keys."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skyloop.errors import UsageError
from skyloop.transport.fabric.layout import ANYONE, check_identity

if TYPE_CHECKING:
    from skyloop.keys import Identity, KeyRing


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """An identity: PEM files for mutual TLS."""

    ca: Path  #: certificate of the authority that signed everybody's
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class FabricSettings:
    """One way into the network; the default finds others by multicast on the segments of this host, without keys.

    ``listen`` and ``connect`` are addresses such as ``10.0.0.5:7447``, ``[::1]:0`` (any free port) or ``10.0.0.5``
    (port 7447). Without keys each stands for TCP (what must arrive) and UDP (commands and feedback), with keys for
    QUIC. An address may also be a whole Zenoh endpoint, ``tcp/10.0.0.5:7447``, which is used as it is.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    multicast: bool = True  #: search, and be found, by UDP multicast on the network segments of this host
    tls: TlsFiles | None = None
    who: str = ANYONE  #: the identity: the common name of the certificate
    #: Zenoh's ``access_control`` section (https://zenoh.io/docs/manual/access-control/), None for none.
    access_control: dict[str, Any] | None = None
    #: The keys that ``tls`` and ``access_control`` were made from.
    ring: KeyRing | None = field(default=None, compare=False)

    @property
    def reach(self) -> str:
        """Where is looked, for people."""
        ways = [*self.connect, *(["multicast"] if self.multicast else [])]
        return ", ".join(ways) or "nowhere"

    @property
    def identity(self) -> Identity | None:
        """Whose keys these are; None without keys."""
        return None if self.ring is None else self.ring.credentials.identity

    def __post_init__(self) -> None:
        check_identity(self.who)
        if self.tls is None and self.who != ANYONE:
            raise UsageError(f"the identity {self.who!r} needs its certificate and key")
