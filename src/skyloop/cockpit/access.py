"""Who asks, and what that person may do: roles, tokens, sessions, certificates.

=============  ====================================================================================================
gate           lets in
=============  ====================================================================================================
``OpenGate``   programs of this user (and of the superuser) on this machine, all in one role; loopback only
``TokenGate``  who once told a token of the file of tokens, and has the cookie that was given for it, or sends the
               token with each request (``Authorization: Bearer …``)
``CertificateGate``  whose TLS certificate is signed by the given authority; its OU names the role, its CN the person
=============  ====================================================================================================
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import stat
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.cockpit.peers import Endpoint, peer_uid
from skyloop.errors import FileFormatError, UsageError
from skyloop.messages import Role

SESSION_S: Final = 12 * 3600.0  #: how long a log-in lasts
MAX_SESSIONS: Final = 1000
SHORTEST_TOKEN: Final = 16  #: characters; a shorter one could be guessed
MAX_TOKEN: Final = 256
CERTIFICATE: Final = "peer_certificate"  #: where the server puts it, in the connection's state

Scope = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Person:
    """Who asks, as far as is known: ``name`` may be empty."""

    role: Role
    name: str = ""

    def may(self, role: Role) -> bool:
        """Whether what needs this role is allowed: a pilot may also observe."""
        return self.role is Role.PILOT or role is Role.OBSERVER


class Gate(Protocol):
    """Says who asks."""

    #: Whether a person can be let in by telling a token.
    takes_tokens: bool
    #: What somebody who is not let in should know.
    hint: str

    def person(self, scope: Scope) -> Person | None:
        """Who sent this request; None if nobody whom it lets in."""


class OpenGate:
    """Everybody on this machine who runs as the same user has one role."""

    takes_tokens = False
    hint = "this cockpit belongs to another user of this machine; with --token-file it asks for a token instead"

    def __init__(self, role: Role = Role.PILOT, uid_of: Callable[[Endpoint, Endpoint], int | None] = peer_uid) -> None:
        self._person = Person(role)
        self._uid_of = uid_of
        self._allowed = {0, os.geteuid()}

    def person(self, scope: Scope) -> Person | None:
        client, server = scope.get("client"), scope.get("server")
        if client is None or server is None:
            return None
        return self._person if self._uid_of(tuple(client), tuple(server)) in self._allowed else None


@dataclass(frozen=True, slots=True)
class Token:
    """One line of the file of tokens."""

    person: Person
    secret: bytes


class TokenGate:
    """Lets in by a token, once told. On the event loop."""

    takes_tokens = True
    hint = "log in with a token"

    def __init__(self, tokens: Iterable[Token], cookie: str, clock: Clock = monotonic_ns) -> None:
        """``cookie`` is the name of the cookie that browsers are given."""
        self.cookie = cookie
        self._tokens = tuple(tokens)
        self._clock = clock
        self._sessions: dict[bytes, tuple[Person, int]] = {}  # by the hash of the cookie, until when [ns]

    def person(self, scope: Scope) -> Person | None:
        header = _header(scope, b"authorization")
        if header is not None:
            kind, _, token = header.partition(" ")
            return self.known(token.strip()) if kind.lower() == "bearer" else None
        given = _cookies(scope).get(self.cookie)
        if given is None:
            return None
        person, until_ns = self._sessions.get(_hash(given), (None, 0))
        return person if self._clock() < until_ns else None

    def known(self, token: str) -> Person | None:
        """Whose token this is. It takes as long for one that is nearly right as for any other."""
        given = token.encode()[: MAX_TOKEN + 1]
        found = None
        for one in self._tokens:
            if hmac.compare_digest(one.secret, given):
                found = one.person
        return found

    def begin(self, person: Person) -> str:
        """A new session's cookie. The oldest sessions make room if there are too many."""
        now_ns = self._clock()
        self._sessions = {key: value for key, value in self._sessions.items() if now_ns < value[1]}
        while len(self._sessions) >= MAX_SESSIONS:
            del self._sessions[next(iter(self._sessions))]
        value = secrets.token_urlsafe(32)
        self._sessions[_hash(value)] = person, now_ns + nanoseconds(SESSION_S)
        return value

    def end(self, scope: Scope) -> None:
        """Log out: the cookie of this request is worth nothing from now on."""
        self._sessions.pop(_hash(_cookies(scope).get(self.cookie, "")), None)


class CertificateGate:
    """Lets in by the certificate that the TLS handshake has verified."""

    takes_tokens = False
    hint = "your certificate names no role: its OU must be pilot or observer"

    def person(self, scope: Scope) -> Person | None:
        return person_of(scope.get("state", {}).get(CERTIFICATE))


def person_of(certificate: Mapping[str, Any] | None) -> Person | None:
    """Role by the organizational unit and name by the common name of a certificate as ``SSLObject.getpeercert()``
    tells it; None if it has no OU that is a role, or two of them."""
    if not certificate:
        return None
    fields = [pair for part in certificate.get("subject", ()) for pair in part]
    units = {value.lower() for key, value in fields if key == "organizationalUnitName"}
    roles = [role for role in Role if role.value in units]
    if len(roles) != 1:
        return None
    name = next((value for key, value in fields if key == "commonName"), "")
    return Person(roles[0], name[:48])


def read_tokens(path: Path) -> list[Token]:
    """The file of tokens: a line for each, ``ROLE TOKEN [NAME]``; empty lines and those that begin with # are left out.

    Raises :class:`UsageError` for a file that is not there or that others may read, :class:`FileFormatError`.
    """
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"the file of tokens {path} can't be read: {error}") from None
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise UsageError(f"the file of tokens {path} is open to others (mode {stat.S_IMODE(mode):04o}): chmod 600 it")
    tokens: list[Token] = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            token = _token(line, f"{path} line {number}")
            if any(token.secret == known.secret for known in tokens):
                raise FileFormatError(f"{path} line {number}: this token is in the file already")
            tokens.append(token)
    if not tokens:
        raise FileFormatError(f"{path} has no token: write a line such as: pilot {secrets.token_urlsafe(24)}")
    return tokens


def _token(line: str, where: str) -> Token:
    role, *rest = line.split(maxsplit=2)
    if role not in list(Role) or not rest:
        raise FileFormatError(f"{where}: ROLE TOKEN [NAME] is needed, with a role of {' or '.join(Role)}")
    if not (rest[0].isascii() and SHORTEST_TOKEN <= len(rest[0]) <= MAX_TOKEN):
        raise FileFormatError(
            f"{where}: a token has {SHORTEST_TOKEN} to {MAX_TOKEN} characters of ASCII, so that it can't be guessed: "
            f"for example {secrets.token_urlsafe(24)}"
        )
    return Token(Person(Role(role), rest[1].strip()[:48] if len(rest) > 1 else ""), rest[0].encode())


def _hash(value: str) -> bytes:
    """What is looked up is a hash: how long that takes tells nothing of the cookie."""
    return hashlib.sha256(value.encode()).digest()


def _header(scope: Scope, wanted: bytes) -> str | None:
    values = [value for name, value in scope["headers"] if name.lower() == wanted]
    return values[0].decode("latin-1") if len(values) == 1 else None


def _cookies(scope: Scope) -> dict[str, str]:
    header = _header(scope, b"cookie") or ""
    pairs = (part.partition("=") for part in header.split(";"))
    return {name.strip(): value.strip() for name, _, value in pairs}
