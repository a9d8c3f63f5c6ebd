"""Load and check an identity's folder, read newer rosters from it, and encode and decode rosters.

================  ==============================================================================
``ca.pem``        the certificate of the lab's authority
``identity.pem``  the identity's certificate
``identity.key``  its private key, readable by its owner only
``roster.json``   all identities in the lab, signed; to be replaced by newer ones
================  ==============================================================================

Zenoh's access control identifies subjects by common name, so every node that enforces it must know all names. The
roster file has two parts: the list, and a signature of exactly the list's bytes. The number increases with each
change, and the roster with the highest number applies.
"""

from __future__ import annotations

import base64
import binascii
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import msgspec

from skyloop.errors import FileFormatError, UsageError
from skyloop.files import expand, read_bytes
from skyloop.network.keys import certificates
from skyloop.network.keys.certificates import Certificate, CertificateAuthority, PrivateKey
from skyloop.network.keys.identity import Identity, KeyRole
from skyloop.platform import change_file, is_open_to_others, lock_file

FORMAT: Final = 1  #: version of the roster's format
_PURPOSE: Final = b"skyloop roster\n"  # prefix of all content that is signed here; no other signature uses it
AUTHORITY_FILE: Final = "ca.pem"
CERTIFICATE_FILE: Final = "identity.pem"
KEY_FILE: Final = "identity.key"
ROSTER_FILE: Final = "roster.json"
MAX_BYTES: Final = 16 << 20  #: maximum size of a file; a roster with 10 000 identities takes 3 MB
NOTICE: Final = timedelta(days=7)  #: time before an expiry from which it is announced


class Entry(msgspec.Struct, frozen=True):
    """One identity. Times are whole seconds since 1970, in UTC."""

    name: str
    role: KeyRole
    drones: tuple[str, ...]
    serial: str  #: serial number of the newest certificate, hexadecimal
    expires: int  #: expiry of the newest certificate
    last: int  #: latest expiry of all certificates issued under this name
    revoked: bool = False

    @property
    def identity(self) -> Identity:
        return Identity(self.name, self.role, self.drones)

    @property
    def expires_at(self) -> datetime:
        """Expiry of the newest certificate, in UTC."""
        return datetime.fromtimestamp(self.expires, UTC)

    @property
    def last_at(self) -> datetime:
        """Latest expiry of all certificates issued under this name, in UTC."""
        return datetime.fromtimestamp(self.last, UTC)


class Roster(msgspec.Struct, frozen=True):
    """All identities, by name."""

    number: int
    lab: str  #: the authority's name
    entries: tuple[Entry, ...] = ()
    format: int = FORMAT

    def find(self, name: str) -> Entry | None:
        return next((entry for entry in self.entries if entry.name == name), None)

    @property
    def identities(self) -> list[Identity]:
        """All identities that may join (not revoked). The handshake checks whether their certificates are valid."""
        return [entry.identity for entry in self.entries if not entry.revoked]

    def put(self, entry: Entry) -> Roster:
        """Return the next roster, in which this entry replaces the entry with the same name."""
        others = [other for other in self.entries if other.name != entry.name]
        entries = tuple(sorted([*others, entry], key=lambda each: each.name))
        return Roster(self.number + 1, self.lab, entries)


class _File(msgspec.Struct):
    roster: msgspec.Raw
    signature: str


def encode_roster(roster: Roster, authority: CertificateAuthority) -> bytes:
    """Return the content of the roster file, signed."""
    body = msgspec.json.format(msgspec.json.encode(roster), indent=1)
    signature = base64.b64encode(authority.sign(_PURPOSE + body)).decode()
    return msgspec.json.encode(_File(msgspec.Raw(body), signature)) + b"\n"


def decode_roster(content: bytes, authority: CertificateAuthority, path: Path) -> Roster:
    """Check the signature of a roster file, then decode it."""
    try:
        file = msgspec.json.decode(content, type=_File)
        signature = base64.b64decode(file.signature, validate=True)
    except (msgspec.MsgspecError, UnicodeDecodeError, binascii.Error, RecursionError) as error:
        raise FileFormatError(f"{path} is not a roster, or is damaged: {error}") from None
    body = bytes(file.roster)
    if not authority.signed(_PURPOSE + body, signature):
        raise UsageError(f"the roster {path} was changed, or is not signed by {authority.name}: copy it again")
    try:
        roster = msgspec.json.decode(body, type=Roster)
    except msgspec.MsgspecError as error:
        raise FileFormatError(f"{path} is a roster of another version of Skyloop: {error}") from None
    if roster.format != FORMAT:
        raise FileFormatError(f"{path} is a roster of format {roster.format}; this version of Skyloop reads {FORMAT}")
    return roster


@dataclass(frozen=True, slots=True)
class Credentials:
    """A verified identity. Paths are absolute, because Zenoh reads the files itself."""

    identity: Identity
    expires: datetime
    authority: CertificateAuthority
    roster: Roster
    directory: Path
    certificate: Certificate = field(repr=False)
    key: PrivateKey = field(repr=False)

    @property
    def name(self) -> str:
        return self.identity.name

    @property
    def role(self) -> KeyRole:
        return self.identity.role

    @property
    def authority_file(self) -> Path:
        return self.directory / AUTHORITY_FILE

    @property
    def certificate_file(self) -> Path:
        return self.directory / CERTIFICATE_FILE

    @property
    def key_file(self) -> Path:
        return self.directory / KEY_FILE

    @property
    def roster_file(self) -> Path:
        return self.directory / ROSTER_FILE

    def ends(self, now: datetime | None = None) -> dict[str, str]:
        """Return warnings for this key and the lab's authority if they have expired or will within a week."""
        now = now or datetime.now(UTC)
        dates = {f"the key of {self.name}": self.expires, "the lab's authority": self.authority.expires}
        return {what: text for what, end in dates.items() if (text := expiry_warning(what, end, now))}

    def renewed(self) -> Credentials | None:
        """Return these credentials with the newer roster if the folder has one, otherwise None."""
        roster = _read_roster(self.directory, self.authority)
        return replace(self, roster=roster) if roster.number > self.roster.number else None


def load(directory: Path | str, now: datetime | None = None) -> Credentials:
    """Read an identity's folder and verify all its files. Raises :class:`UsageError`, which says how to fix it."""
    now = now or datetime.now(UTC)
    path = expand(directory).resolve()
    _check_folder(path)
    certificate_path, key_path = path / CERTIFICATE_FILE, path / KEY_FILE
    key = certificates.read_key(read_private(key_path, "the private key"), key_path)
    certificate = certificates.read_certificate(read(certificate_path, "the certificate"), certificate_path)
    authority = _read_authority(path)
    if not certificates.matches(key, certificate):
        raise UsageError(f"{key_path} does not belong to the certificate {certificate_path}: copy both from one folder")
    certificates.check_issued(certificate, authority, certificate_path)
    certificates.check_time(authority.certificate, f"the lab's authority, {path / AUTHORITY_FILE},", now)
    certificates.check_time(certificate, f"the key {path}", now)
    identity = certificates.identity_of(certificate, certificate_path)
    roster = _read_roster(path, authority)
    _check_listed(identity, roster, path)
    return Credentials(identity, certificate.not_valid_after_utc, authority, roster, path, certificate, key)


def read_public(directory: Path) -> tuple[CertificateAuthority, Roster]:
    """Read the public certificate and the roster from a folder of a lab or an identity."""
    if not directory.is_dir():
        raise UsageError(f"there is no folder {directory}: make a lab's with skyloop keys init")
    authority = _read_authority(directory)
    return authority, _read_roster(directory, authority)


def expiry_warning(what: str, end: datetime, now: datetime) -> str:
    """Return a sentence for users if the key has expired or expires within a week; otherwise an empty string."""
    left = end - now
    if left > NOTICE:
        return ""
    day = f"{end:%Y-%m-%d %H:%M} UTC"
    if left <= timedelta(0):
        return f"{what} expired on {day}: issue a new one (skyloop keys issue)"
    hours = left / timedelta(hours=1)
    rest = f"{hours / 24:.0f} days" if hours >= 36 else f"{hours:.0f} h"
    return f"{what} expires in {rest}, on {day}: issue a new one (skyloop keys issue)"


def _read_authority(directory: Path) -> CertificateAuthority:
    path = directory / AUTHORITY_FILE
    return certificates.read_authority(
        certificates.read_certificate(read(path, "the authority's certificate"), path), None, path
    )


def _read_roster(directory: Path, authority: CertificateAuthority) -> Roster:
    path = directory / ROSTER_FILE
    return decode_roster(read(path, "the roster"), authority, path)


def _check_folder(path: Path) -> None:
    if not path.is_dir():
        raise UsageError(f"there is no folder {path}: give an identity's folder made by skyloop keys issue")
    if (path / "ca.key").exists():
        raise UsageError(
            f"{path} is the folder of the lab's authority, which no program on the network needs: give an "
            f"identity's folder, such as {path / 'issued' / 'NAME'}"
        )


def _check_listed(identity: Identity, roster: Roster, path: Path) -> None:
    entry = roster.find(identity.name)
    if entry is None:
        raise UsageError(f"{identity.name} is not on the roster in {path}: copy the newest roster.json there")
    if entry.revoked:
        raise UsageError(f"{identity.name} was revoked: issue a key under another name")
    if entry.identity != identity:
        raise UsageError(
            f"the key {path} is of {identity}, but the roster says {entry.identity}: the key was replaced, "
            "use the new one"
        )


# Files that hold keys: access rights and atomic replacement -----------------------------------------------------------


def make_directory(path: Path) -> None:
    """Create a directory that only its owner can enter, or check an existing one."""
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = path.stat().st_mode
    except OSError as error:
        raise UsageError(f"{path} can't be created: {error.strerror}") from None
    if is_open_to_others(mode):
        raise UsageError(f"{path} is open to others (mode {stat.S_IMODE(mode):04o}): chmod 700 it")


def write(path: Path, content: bytes, *, private: bool = False) -> None:
    """Replace a file atomically. A private file is readable only by its owner, from the moment of its creation."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if private else 0o644)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        change_file(lambda: temporary.replace(path))
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UsageError(f"{path} can't be written: {error.strerror}") from None


def read(path: Path, what: str) -> bytes:
    """Read a file of at most :data:`MAX_BYTES`."""
    return read_bytes(path, what, MAX_BYTES)


def read_private(path: Path, what: str) -> bytes:
    """Read a file that must not be accessible to others, because they might have copied the key in it."""
    content = read(path, what)
    mode = path.stat().st_mode
    if is_open_to_others(mode):
        raise UsageError(
            f"{what} {path} is open to others (mode {stat.S_IMODE(mode):04o}): chmod 600 it, and issue a new one if "
            "others may have read it"
        )
    return content


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Lock a directory against changes by other processes. Waits for the lock, which ends with its process."""
    if sys.platform == "win32":  # where directories can't be opened: lock a file in it instead
        descriptor = os.open(directory / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
    else:
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        lock_file(descriptor, None)
        yield
    finally:
        os.close(descriptor)
