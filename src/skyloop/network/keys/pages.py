"""Certificates for cockpits' pages: browsers decode video, and keep the screen on, over https only.

They come from an authority of their own, in a folder beside the lab's keys. Browsers are asked to trust it, and may: it
can certify nothing beyond private networks. Its key gives no access to the lab's network, and the lab's none to pages.

=====================  =====================================================================
``ca.pem``             the certificate that browsers are to trust
``ca.key``             the authority's key
``page.pem``           the page's certificate, for the addresses and names of this machine
``page.key``           its key
=====================  =====================================================================
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from skyloop.errors import UsageError
from skyloop.network.keys import certificates, files
from skyloop.network.keys.certificates import Authority

FOLDER: Final = "pages"  #: in the lab's folder
AUTHORITY_DAYS: Final = 1825
PAGE_DAYS: Final = 366  #: browsers refuse a certificate that is valid for much longer
RENEWED_DAYS: Final = 60  #: a certificate with less left is replaced when the cockpit starts


@dataclass(frozen=True, slots=True)
class PageFiles:
    """The files of a page's certificate, PEM."""

    certificate: Path
    key: Path
    authority: Path  #: the certificate that browsers are to trust
    left_out: tuple[str, ...] = ()  #: own names of the machine that the authority may not certify


def page_certificate(
    directory: Path, own: Sequence[str], wanted: Sequence[str] = (), now: datetime | None = None
) -> PageFiles:
    """Return a certificate for a cockpit's page: the one that is there if it fits, or else a new one.

    Args:
        directory: The folder, made if it is missing.
        own: Addresses and names of this machine; those that the authority may not certify are left out.
        wanted: Names that people gave.
        now: The time in UTC; by default of this machine.

    Raises:
        UsageError: A name in ``wanted`` may not be certified, no name is left, or a file can't be used.
        MissingExtraError: The extra ``network`` is not installed.
    """
    now = datetime.now(UTC) if now is None else now
    files.make_directory(directory.parent)
    files.make_directory(directory)
    made = PageFiles(directory / "page.pem", directory / "page.key", directory / "ca.pem")
    with files.locked(directory):
        authority = _authority(directory, made.authority, [*own, *wanted], now)
        for name in wanted:
            if not certificates.may_certify(authority, name):
                raise UsageError(
                    f"{name} can't be certified by {made.authority}, which is for private networks and the names of "
                    f"when it was made: give --tls-cert and --tls-key, or remove {directory} to make it anew, which "
                    "browsers then have to trust again"
                )
        names = [name.lower() for name in dict.fromkeys([*own, *wanted]) if certificates.may_certify(authority, name)]
        if not names:
            raise UsageError(f"none of {', '.join(own)} is private: give --tls-cert and --tls-key")
        if not _fits(made, authority, names, now):
            key = certificates.new_key()
            page = certificates.issue_page(authority, names, key, now + timedelta(days=PAGE_DAYS), now)
            files.write(made.key, certificates.key_pem(key), private=True)
            files.write(made.certificate, certificates.certificate_pem(page))
    left_out = tuple(name for name in own if not certificates.may_certify(authority, name))
    return PageFiles(made.certificate, made.key, made.authority, left_out)


def _authority(directory: Path, path: Path, names: Sequence[str], now: datetime) -> Authority:
    key_path = directory / "ca.key"
    if key_path.exists():
        key = certificates.read_key(files.read_private(key_path, "the key of the pages' authority"), key_path)
        certificate = certificates.read_certificate(files.read(path, "the pages' authority"), path)
        authority = certificates.read_authority(certificate, key, path)
        if authority.expires - now > timedelta(days=RENEWED_DAYS):
            return authority
    more = [name.lower() for name in names if not _is_address(name)]
    authority = certificates.make_page_authority(more, AUTHORITY_DAYS, now)
    assert authority.key is not None
    files.write(path, certificates.certificate_pem(authority.certificate))
    files.write(key_path, certificates.key_pem(authority.key), private=True)
    return authority


def _fits(made: PageFiles, authority: Authority, names: Sequence[str], now: datetime) -> bool:
    if not (made.certificate.exists() and made.key.exists()):
        return False
    page = certificates.read_certificate(files.read(made.certificate, "the page's certificate"), made.certificate)
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
