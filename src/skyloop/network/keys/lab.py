"""Manage a lab's authority (a folder that issues and revokes identities) and the certificates for cockpit pages.

================  ========================================================================
``ca.key``        the authority's private key: its holder can create any identity
``ca.pem``        its certificate
``roster.json``   all identities, signed
``issued/NAME/``  one identity's folder, to be copied to its machine
================  ========================================================================

Pages need certificates because browsers decode video, and keep the screen on, only over https. These are issued by a
separate authority, in the folder ``pages`` inside the user's folder of keys. Users make their browsers trust it. This
is safe because the authority can't certify anything beyond private networks. Neither authority's key can stand in for
the other's.

============  ==========================================================================
``ca.pem``    the certificate for browsers to trust
``ca.key``    the authority's key
``page.pem``  the page's certificate, for the addresses and names of this machine
``page.key``  its key
============  ==========================================================================
"""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import msgspec

from skyloop.errors import UnknownNameError, UsageError
from skyloop.network.keys import certificates
from skyloop.network.keys.certificates import CertificateAuthority
from skyloop.network.keys.credentials import (
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    ROSTER_FILE,
    Entry,
    Roster,
    decode_roster,
    encode_roster,
    locked,
    make_directory,
    read,
    read_private,
    write,
)
from skyloop.network.keys.identity import Identity

AUTHORITY_DAYS: Final = 1825  #: default validity of a lab's authority
IDENTITY_DAYS: Final = 30.0  #: default validity period of an identity
MAX_IDENTITY_DAYS: Final = 366.0  #: maximum validity period of an identity
_AUTHORITY_KEY: Final = "ca.key"
_ISSUED: Final = "issued"
PAGE_DAYS: Final = 366  #: browsers reject certificates that are valid for much longer
RENEWED_DAYS: Final = 60  #: when the cockpit starts, it replaces a certificate that is valid for fewer days than this


class Lab:
    """An authority that can issue identities. Created by :meth:`make` or opened by :meth:`open`.

    Each change holds a lock on the folder, so that a change by another process at the same time is not lost.
    """

    def __init__(self, directory: Path, authority: CertificateAuthority) -> None:
        self.directory = directory
        self.authority = authority

    @classmethod
    def make(cls, directory: Path, days: int = AUTHORITY_DAYS, now: datetime | None = None) -> Lab:
        """Create a new authority in a new folder, valid for 1 to 36500 days."""
        if not 1 <= days <= 36500:
            raise UsageError(f"an authority is valid for 1 to 36500 days, not {days}")
        make_directory(directory)
        with locked(directory):
            if (directory / _AUTHORITY_KEY).exists():
                raise UsageError(f"{directory} already has an authority: a new one would make all its keys worthless")
            authority = certificates.make_authority(days, _now(now))
            assert authority.key is not None
            lab = cls(directory, authority)
            write(directory / AUTHORITY_FILE, certificates.certificate_pem(authority.certificate))
            lab._write_roster(Roster(1, authority.name))
            write(directory / _AUTHORITY_KEY, certificates.key_pem(authority.key), private=True)
        return lab

    @classmethod
    def open(cls, directory: Path) -> Lab:
        """Open the authority in a folder."""
        key_path, certificate_path = directory / _AUTHORITY_KEY, directory / AUTHORITY_FILE
        if not key_path.exists():
            raise UsageError(f"there is no authority in {directory}: make one with skyloop keys init")
        key = certificates.read_key(read_private(key_path, "the authority's key"), key_path)
        content = read(certificate_path, "the authority's certificate")
        certificate = certificates.read_certificate(content, certificate_path)
        return cls(directory, certificates.read_authority(certificate, key, certificate_path))

    @property
    def roster(self) -> Roster:
        """The roster in the folder. Raises :class:`UsageError` if it can't be read or was modified."""
        path = self.directory / ROSTER_FILE
        return decode_roster(read(path, "the roster"), self.authority, path)

    def folder(self, name: str) -> Path:
        return self.directory / _ISSUED / name

    def issue(self, identity: Identity, days: float = IDENTITY_DAYS, now: datetime | None = None) -> Entry:
        """Create or renew an identity's key and certificate. A revoked name is free once its lost key has expired."""
        now = _now(now)
        if not (math.isfinite(days) and 0 < days <= MAX_IDENTITY_DAYS):
            raise UsageError(f"a key is valid for more than 0 and at most {MAX_IDENTITY_DAYS:g} days, not {days:g}")
        certificates.check_time(self.authority.certificate, "the lab's authority", now)
        with locked(self.directory):
            before = self.roster.find(identity.name)
            if before is not None and before.revoked and now < before.last_at:
                raise UsageError(
                    f"{identity.name} was revoked, and the lost key is valid until {before.last_at:%Y-%m-%d}: "
                    "choose another name"
                )
            key = certificates.new_key()
            certificate = certificates.issue(self.authority, identity, key, now + timedelta(days=days), now)
            expires, serial = int(certificate.not_valid_after_utc.timestamp()), f"{certificate.serial_number:x}"
            last = max(expires, before.last) if before else expires
            entry = Entry(identity.name, identity.role, identity.drones, serial, expires, last)
            folder = self.folder(identity.name)
            make_directory(folder)
            write(folder / KEY_FILE, certificates.key_pem(key), private=True)
            write(folder / CERTIFICATE_FILE, certificates.certificate_pem(certificate))
            write(folder / AUTHORITY_FILE, certificates.certificate_pem(self.authority.certificate))
            self._write_roster(self.roster.put(entry))
        return entry

    def revoke(self, name: str) -> Entry:
        """Revoke an identity wherever the new roster is installed, and delete its folder's files here."""
        with locked(self.directory):
            roster = self.roster
            entry = roster.find(name)
            if entry is None:
                raise UnknownNameError("key", name, [each.name for each in roster.entries])
            if entry.revoked:
                raise UsageError(f"{name} is already revoked")
            revoked = msgspec.structs.replace(entry, revoked=True)
            self._write_roster(roster.put(revoked))
            for file in (KEY_FILE, CERTIFICATE_FILE, AUTHORITY_FILE, ROSTER_FILE):
                (self.folder(name) / file).unlink(missing_ok=True)
        return revoked

    def _write_roster(self, roster: Roster) -> None:
        """Write the roster to the folders of the lab and of all identities, so that every copy is the newest one."""
        content = encode_roster(roster, self.authority)
        write(self.directory / ROSTER_FILE, content)
        for entry in roster.entries:
            folder = self.folder(entry.name)
            if not entry.revoked and folder.is_dir():
                write(folder / ROSTER_FILE, content)


def _now(now: datetime | None) -> datetime:
    return now or datetime.now(UTC)


@dataclass(frozen=True, slots=True)
class PageFiles:
    """The PEM files of a page's certificate."""

    certificate: Path
    key: Path
    authority: Path  #: the certificate for browsers to trust
    left_out: tuple[str, ...] = ()  #: this machine's names that the authority may not certify


def page_certificate(
    directory: Path, own: Sequence[str], wanted: Sequence[str] = (), now: datetime | None = None
) -> PageFiles:
    """Return a certificate for a cockpit's page: the existing certificate if it is suitable, otherwise a new one.

    ``own``: this machine's addresses and names. Those that the authority may not certify are left out. ``wanted``:
    names given by the user, which the authority must be able to certify.
    """
    now = datetime.now(UTC) if now is None else now
    make_directory(directory.parent)
    make_directory(directory)
    made = PageFiles(directory / "page.pem", directory / "page.key", directory / "ca.pem")
    with locked(directory):
        authority = _authority(directory, made.authority, [*own, *wanted], now)
        for name in wanted:
            if not certificates.may_certify(authority, name):
                raise UsageError(
                    f"{name} can't be certified by {made.authority}, which covers private networks and the names given "
                    f"at its creation: give --tls-cert and --tls-key, or remove {directory} to make a new one, which "
                    "browsers then have to trust again"
                )
        names = [name.lower() for name in dict.fromkeys([*own, *wanted]) if certificates.may_certify(authority, name)]
        if not names:
            raise UsageError(f"none of {', '.join(own)} is private: give --tls-cert and --tls-key")
        if not _fits(made, authority, names, now):
            key = certificates.new_key()
            page = certificates.issue_page(authority, names, key, now + timedelta(days=PAGE_DAYS), now)
            write(made.key, certificates.key_pem(key), private=True)
            write(made.certificate, certificates.certificate_pem(page))
    left_out = tuple(name for name in own if not certificates.may_certify(authority, name))
    return PageFiles(made.certificate, made.key, made.authority, left_out)


def _authority(directory: Path, path: Path, names: Sequence[str], now: datetime) -> CertificateAuthority:
    key_path = directory / "ca.key"
    if key_path.exists():
        key = certificates.read_key(read_private(key_path, "the key of the pages' authority"), key_path)
        certificate = certificates.read_certificate(read(path, "the pages' authority"), path)
        authority = certificates.read_authority(certificate, key, path)
        if authority.expires - now > timedelta(days=RENEWED_DAYS):
            return authority
    more = [name.lower() for name in names if not _is_address(name)]
    authority = certificates.make_page_authority(more, AUTHORITY_DAYS, now)
    assert authority.key is not None
    write(path, certificates.certificate_pem(authority.certificate))
    write(key_path, certificates.key_pem(authority.key), private=True)
    return authority


def _fits(made: PageFiles, authority: CertificateAuthority, names: Sequence[str], now: datetime) -> bool:
    if not (made.certificate.exists() and made.key.exists()):
        return False
    page = certificates.read_certificate(read(made.certificate, "the page's certificate"), made.certificate)
    try:
        certificates.check_issued(page, authority, made.certificate)
    except UsageError:
        return False
    lasts = page.not_valid_after_utc - now > timedelta(days=RENEWED_DAYS)
    return lasts and set(names) <= set(certificates.page_names(page))


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
