"""Determine who sent a request and what that person may do: roles, tokens, sessions, certificates.

===================  ==============================================================================================
gate                 admits
===================  ==============================================================================================
``OpenGate``         programs of this user (and of the superuser) on this machine, all in one role; loopback only
``TokenGate``        browsers that exchanged a token from the token file, or the one-time pairing code shown in the
                     terminal, for a session cookie; requests with a token (``Authorization: Bearer …``)
``CertificateGate``  clients whose TLS certificate the given authority signed; its OU names the role, its CN the person
===================  ==============================================================================================
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import os
import secrets
import stat
import struct
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import msgspec

from skyloop.clock import Clock, boot_id, monotonic_ns, nanoseconds, seconds
from skyloop.errors import FileFormatError, UsageError
from skyloop.files import decoded
from skyloop.messages import Role
from skyloop.platform import is_open_to_others, is_own_user

SESSION_S: Final = 12 * 3600.0  #: period for which a session is valid
PAIRING_S: Final = 3600.0  #: period for which a pairing code is valid
MAX_SESSIONS: Final = 1000  #: a further log-in ends the oldest session
SHORTEST_TOKEN: Final = 16  #: minimum length in characters; a shorter token could be guessed
MAX_TOKEN: Final = 256  #: maximum length in characters
CERTIFICATE: Final = "peer_certificate"  #: key under which a connection's state holds the client's certificate

FIRST_S: Final = 0.25  #: delay after the first wrong token from an address; doubled by each further one
LONGEST_S: Final = 16.0  #: must be less than :data:`skyloop.cockpit.listening.ANSWER_S`, or no response would arrive
FORGET_S: Final = 600.0  #: an address starts over if it has sent no wrong token for this long
MAX_ADDRESSES: Final = 1024  #: maximum number of addresses remembered; the quietest one is forgotten first
FREE_IN_ALL: Final = 20  #: wrong tokens allowed per minute, over all addresses, before the delay below is added
EACH_IN_ALL_S: Final = 0.1  #: additional delay for each wrong token beyond those, from any address
MOST_IN_ALL_S: Final = 4.0  #: maximum of this additional delay
_MINUTE_NS: Final = nanoseconds(60.0)

_TABLES: Final = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_WORD: Final = "<I" if sys.byteorder == "little" else ">I"
_LOCAL, _REMOTE, _UID, _INODE = 1, 2, 7, 9  # column indexes in these tables

Scope = Mapping[str, Any]
Endpoint = tuple[str, int]  #: address and port

MAX_NAME: Final = 40  #: maximum length of a name chosen by a person
_log = logging.getLogger(__name__)


def peer_uid(client: Endpoint, server: Endpoint) -> int | None:
    """Return the user id of the program at the client end of a loopback connection, or None if it is unknown.

    The kernel's tables of sockets (``/proc/net/tcp`` and ``tcp6``, Linux only) are described in proc_pid_net(5) and in
    the kernel's ``proc_net_tcp.txt``. A socket that its program has already closed is listed with user 0 and inode 0,
    so an entry without an inode does not reveal who opened the socket.
    """
    for table in _TABLES:
        with suppress(OSError):
            found = uid_in(table.read_text(), client, server)
            if found is not None:
                return found
    return None


def uid_in(table: str, client: Endpoint, server: Endpoint) -> int | None:
    """Return the owner of the socket from ``client`` to ``server`` in a table; None if it is missing or has none."""
    wanted = {(_table_entry(client, mapped), _table_entry(server, mapped)) for mapped in (False, True)}
    for line in table.splitlines()[1:]:
        cells = line.split()
        if len(cells) > _INODE and (cells[_LOCAL], cells[_REMOTE]) in wanted:
            return int(cells[_UID]) if cells[_INODE] != "0" else None
    return None


def _table_entry(end: Endpoint, mapped: bool) -> str:
    """Format an address as the table does, in 32-bit words of host order. ``mapped``: write IPv4 as IPv6."""
    address = ipaddress.ip_address(end[0])
    packed = address.packed
    if mapped and address.version == 4:
        packed = ipaddress.IPv6Address(f"::ffff:{address}").packed
    words = "".join(f"{word:08X}" for (word,) in struct.iter_unpack(_WORD, packed))
    return f"{words}:{end[1]:04X}"


@dataclass(frozen=True, slots=True)
class Person:
    """The person who sent a request; ``name`` is empty if unknown."""

    role: Role
    name: str = ""

    def may(self, role: Role) -> bool:
        """Return whether this person has the permissions of a role: a pilot may also observe."""
        return self.role is Role.PILOT or role is Role.OBSERVER

    def display_name(self, requested: str) -> str:
        """Return the name shown to others; ``requested`` is used only if the token or certificate contains no name."""
        return self.name or " ".join("".join(filter(str.isprintable, requested)).split())[:MAX_NAME]


class Gate(Protocol):
    """Determines who sent a request."""

    #: Whether people can log in with a token.
    takes_tokens: bool
    #: The hint for a person who is refused.
    hint: str

    def person(self, scope: Scope) -> Person | None:
        """Return the person who sent this request, or None if that person is not admitted."""


class OpenGate:
    """Gives one role to every program of this user, or of the superuser, on this machine.

    ``uid_of``: returns the client's user id, given the addresses of both ends.
    """

    takes_tokens = False
    hint = "this cockpit belongs to another user of this machine; with --token-file it asks for a token instead"

    def __init__(self, role: Role = Role.PILOT, uid_of: Callable[[Endpoint, Endpoint], int | None] = peer_uid) -> None:
        self._person = Person(role)
        self._uid_of = uid_of

    def person(self, scope: Scope) -> Person | None:
        client, server = scope.get("client"), scope.get("server")
        if client is None or server is None:
            return None
        return self._person if is_own_user(self._uid_of(tuple(client), tuple(server)), or_root=True) else None


@dataclass(frozen=True, slots=True)
class Token:
    """One line of the token file."""

    person: Person
    secret: bytes = field(repr=False)


class Pairing:
    """Issues codes, each of which admits one browser, only once and within :data:`PAIRING_S`. Used on the event loop.

    ``role``: the role given to browsers that use a code.
    """

    def __init__(self, role: Role, clock: Clock = monotonic_ns) -> None:
        self.on_used: Callable[[str], None] = lambda _: None  #: called with address and role once a code has been used
        self.on_expired: Callable[[], None] = lambda: None  #: called once a code has expired
        self.role = role
        self._clock = clock
        self._code = ""
        self._until_ns = 0

    def code(self) -> str:
        """Return a new code, which invalidates earlier ones."""
        self._code = secrets.token_urlsafe(24)
        self._until_ns = self._clock() + nanoseconds(PAIRING_S)
        return self._code

    def expire(self) -> None:
        """Drop the code if it has expired; this method must be called a few times a minute."""
        if self._code != "" and self._clock() >= self._until_ns:
            self._code = ""
            self.on_expired()

    def person(self, code: str, address: str) -> Person | None:
        """Return the person whose code this is, and invalidate the code; None if it is not the current code."""
        works = self._code != "" and self._clock() < self._until_ns
        if not works or not hmac.compare_digest(self._code.encode(), code.encode()):
            return None
        self._code = ""
        self.on_used(f"{address} as {self.role}")
        return Person(self.role, "paired")


class TokenGate:
    """Admits people by a token, sent with each request or exchanged for a session cookie. Used on the event loop."""

    takes_tokens = True
    hint = "log in with a token"

    def __init__(
        self,
        tokens: Iterable[Token],
        cookie: str,
        clock: Clock = monotonic_ns,
        *,
        pairing: Pairing | None = None,
        kept: SessionFile | None = None,
    ) -> None:
        """Restore the saved sessions whose token or pairing role is still valid.

        ``pairing``: issues one-time codes that can be used instead of a token. ``kept``: where sessions are stored
        between runs of the cockpit.
        """
        self.cookie = cookie
        self.pairing = pairing
        self.wrong = WrongTokens(clock)
        self._tokens = tuple(tokens)
        self._clock = clock
        self._kept = kept
        saved = [] if kept is None else kept.load()
        self._sessions = {one.cookie: one for one in saved if self._still_lets_in(one)}  # keyed by cookie hash

    def person(self, scope: Scope) -> Person | None:
        header = _header(scope, b"authorization")
        if header is not None:
            kind, _, token = header.partition(" ")
            return self.known(token.strip()) if kind.lower() == "bearer" else None
        given = _cookies(scope).get(self.cookie)
        if given is None:
            return None
        session = self._sessions.get(_hash(given))
        return Person(session.role, session.name) if session is not None and self._clock() < session.until_ns else None

    def wrong_token_s(self, scope: Scope) -> float:
        """Count a wrong token; return how long to delay the response [s]."""
        return self.wrong.another(_address(scope))

    def known(self, token: str) -> Person | None:
        """Return the owner of a token, or None if it is unknown, in a time that reveals nothing about known tokens."""
        given = token.encode()[: MAX_TOKEN + 1]
        found = None
        for one in self._tokens:
            if hmac.compare_digest(one.secret, given):
                found = one.person
        return found

    def logged_in(self, token: str, scope: Scope) -> Person | None:
        """Return the person who has this token or pairing code, and invalidate a code; None if it is neither."""
        found = self.known(token)
        if found is None and self.pairing is not None:
            found = self.pairing.person(token, _address(scope))
        return found

    def begin(self, person: Person, token: str = "") -> str:
        """Begin a session and return its cookie; drop the oldest if there are too many. ``token``: its origin."""
        now_ns = self._clock()
        self._sessions = {key: one for key, one in self._sessions.items() if now_ns < one.until_ns}
        while len(self._sessions) >= MAX_SESSIONS:
            del self._sessions[next(iter(self._sessions))]
        value = secrets.token_urlsafe(32)
        origin = _hash(token) if self.known(token) is not None else b""
        session = LoginSession(_hash(value), origin, person.role, person.name, now_ns + nanoseconds(SESSION_S))
        self._sessions[session.cookie] = session
        self._keep()
        return value

    def end(self, scope: Scope) -> None:
        """End the session of this request's cookie."""
        if self._sessions.pop(_hash(_cookies(scope).get(self.cookie, "")), None) is not None:
            self._keep()

    def _keep(self) -> None:
        if self._kept is not None:
            self._kept.save(self._sessions.values())

    def _still_lets_in(self, session: LoginSession) -> bool:
        """Return whether a session would be admitted now: its token is still known, or pairing still gives its role."""
        if session.origin == b"":
            return self.pairing is not None and self.pairing.role is session.role
        person = Person(session.role, session.name)
        return any(_hash(one.secret.decode()) == session.origin and one.person == person for one in self._tokens)


class CertificateGate:
    """Admits people by the certificate that the TLS handshake verified."""

    takes_tokens = False
    hint = "your certificate names no role: its OU must be pilot or observer"

    def person(self, scope: Scope) -> Person | None:
        return person_of(scope.get("state", {}).get(CERTIFICATE))


def person_of(certificate: Mapping[str, Any] | None) -> Person | None:
    """Return the role and name in an ``SSLObject.getpeercert()`` certificate; None unless exactly one OU is a role."""
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
    """Read the token file.

    Each line has the form ``ROLE TOKEN [NAME]``; empty lines and lines starting with # are skipped. Raise
    ``UsageError`` if the file can't be read or others can read it, and ``FileFormatError`` if a line is invalid or
    there is no token.
    """
    try:
        mode = path.stat().st_mode
        text = decoded(path.read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"the token file {path} can't be read: {error}") from None
    if is_open_to_others(mode):
        raise UsageError(f"the token file {path} is readable by others (mode {stat.S_IMODE(mode):04o}): chmod 600 it")
    tokens: list[Token] = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            token = _token(line, f"{path} line {number}")
            if any(token.secret == known.secret for known in tokens):
                raise FileFormatError(f"{path} line {number}: this token is already in the file")
            tokens.append(token)
    if not tokens:
        raise FileFormatError(f"{path} has no token: write a line such as: pilot {secrets.token_urlsafe(24)}")
    return tokens


def _token(line: str, where: str) -> Token:
    role, *rest = line.split(maxsplit=2)
    if role not in list(Role) or not rest:
        raise FileFormatError(f"{where}: expected ROLE TOKEN [NAME], where the role is {' or '.join(Role)}")
    if not (rest[0].isascii() and SHORTEST_TOKEN <= len(rest[0]) <= MAX_TOKEN):
        raise FileFormatError(
            f"{where}: a token needs {SHORTEST_TOKEN} to {MAX_TOKEN} ASCII characters, so that it can't be guessed: "
            f"for example {secrets.token_urlsafe(24)}"
        )
    return Token(Person(Role(role), rest[1].strip()[:48] if len(rest) > 1 else ""), rest[0].encode())


def _hash(value: str) -> bytes:
    """Hash a cookie, so that the time needed to look it up reveals nothing about it."""
    return hashlib.sha256(value.encode()).digest()


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return str(client[0]) if client else "a disconnected client"


def _header(scope: Scope, wanted: bytes) -> str | None:
    values = [value for name, value in scope["headers"] if name.lower() == wanted]
    return values[0].decode("latin-1") if len(values) == 1 else None


def has_token(scope: Scope) -> bool:
    return any(name.lower() == b"authorization" for name, _ in scope["headers"])


def _cookies(scope: Scope) -> dict[str, str]:
    header = _header(scope, b"cookie") or ""
    pairs = (part.partition("=") for part in header.split(";"))
    return {name.strip(): value.strip() for name, _, value in pairs}


class WrongTokens:
    """Determines how long to delay the response to a wrong token. Used on the event loop.

    The delay grows with the number of wrong tokens, both from the same address and in total. A correct token is never
    delayed, so an attacker can't lock out the token's owner, not even from the same address. Only rejections are
    delayed: an attacker who waits for the responses can make only a few guesses. An attacker who takes silence for a
    rejection is limited only by the rate of connections; the length of the tokens protects against such attacks.
    """

    def __init__(self, clock: Clock = monotonic_ns) -> None:
        self.count = 0  #: number of wrong tokens since startup
        self._clock = clock
        self._of_address: dict[str, tuple[int, int]] = {}  # number of wrong tokens, time of the last; quietest first
        self._minute_ns = clock()
        self._in_minute = 0

    def another(self, address: str) -> float:
        """Count a wrong token from an address; return how long to delay the response [s]."""
        now_ns = self._clock()
        before, last_ns = self._of_address.pop(address, (0, now_ns))
        many = 1 if seconds(now_ns - last_ns) >= FORGET_S else before + 1
        self._of_address[address] = many, now_ns
        if len(self._of_address) > MAX_ADDRESSES:
            del self._of_address[next(iter(self._of_address))]
        if now_ns - self._minute_ns >= _MINUTE_NS:
            self._minute_ns, self._in_minute = now_ns, 0
        self._in_minute += 1
        self.count += 1
        if many.bit_count() == 1:  # log 1, 2, 4, 8, … wrong tokens, so that an attacker can't fill the log
            _log.warning("%d wrong tokens from %s", many, address)
        of_address_s = min(LONGEST_S, FIRST_S * 2.0 ** min(many - 1, 16))
        in_all_s = min(MOST_IN_ALL_S, EACH_IN_ALL_S * max(0, self._in_minute - FREE_IN_ALL))
        return min(LONGEST_S, of_address_s + in_all_s)


# Sessions that outlive the cockpit's process ---------------------------------------------------------------------


MAX_BYTES: Final = 1_000_000  #: the file's maximum size; a longer one counts as damaged


class LoginSession(msgspec.Struct, frozen=True):
    """One log-in."""

    cookie: bytes  #: the cookie's hash
    origin: bytes  #: hash of the token for which the session was created; empty if it was created for a pairing code
    role: Role
    name: str
    until_ns: int  #: expiry on the monotonic clock


class _Content(msgspec.Struct):
    boot: str
    sessions: list[LoginSession]


class SessionFile:
    """Stores the sessions of one cockpit, so that after a restart a page reconnects without logging in again.

    Only this user may read the file, which is next to the proxies' sockets. It contains hashes of cookies and tokens,
    which can't be used to log in. Its times are on the monotonic clock, so a reboot invalidates them.
    """

    def __init__(self, path: Path, boot: str | None = None) -> None:
        self._path = path
        self._boot = boot_id() if boot is None else boot

    def load(self) -> list[LoginSession]:
        """Return the sessions; none if the file is missing, damaged, owned by others or from before a reboot."""
        try:
            descriptor = os.open(self._path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
            with os.fdopen(descriptor, "rb") as file:
                found = os.fstat(file.fileno())
                own = is_own_user(found.st_uid) and not is_open_to_others(found.st_mode)
                content = msgspec.json.decode(file.read(MAX_BYTES), type=_Content) if own else None
        except (OSError, msgspec.DecodeError):
            return []
        return content.sessions if content is not None and self._boot and content.boot == self._boot else []

    def save(self, sessions: Iterable[LoginSession]) -> None:
        """Replace the file. If this fails, the only consequence is that people have to log in again after a restart."""
        new = self._path.with_name(f"{self._path.name}.new")
        try:
            with suppress(FileNotFoundError):
                new.unlink()
            descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.encode(_Content(self._boot, list(sessions))))
            new.replace(self._path)
        except OSError as error:
            _log.warning("log-ins will not survive a restart of the cockpit: %s", error)
