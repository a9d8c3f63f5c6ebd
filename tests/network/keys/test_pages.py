"""Certificates of cockpit pages: for this machine's names, by an authority that can certify nothing else."""

from __future__ import annotations

import shutil
import socket
import ssl
import threading
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from skyloop.errors import UsageError
from skyloop.network.keys import certificates
from skyloop.network.keys.lab import PAGE_DAYS, PageFiles, page_certificate

NOW = datetime.now(UTC)
OWN = ["localhost", "127.0.0.1", "box", "192.168.1.5"]


def handshake(made: PageFiles, name: str) -> None:
    """Connect like a browser that trusts the authority."""
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(made.certificate, made.key)
    here, there = socket.socketpair()

    def serve() -> None:
        with there, suppress(OSError):  # the other end reports the reason
            server.wrap_socket(there, server_side=True).close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with here, ssl.create_default_context(cafile=made.authority).wrap_socket(here, server_hostname=name):
            pass
    finally:
        thread.join()


def test_a_browser_that_trusts_the_authority_trusts_the_page_by_all_its_names(tmp_path: Path) -> None:
    made = page_certificate(tmp_path / "keys" / "pages", [*OWN, "8.8.8.8"], ["drones.lab"], NOW)
    for name in (*OWN, "drones.lab"):
        handshake(made, name)
    assert made.left_out == ("8.8.8.8",), "no Internet address"
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(made, "other.lab")
    assert made.key.stat().st_mode & 0o077 == 0


def test_the_authority_vouches_for_no_other_site(tmp_path: Path) -> None:
    made = page_certificate(tmp_path / "keys" / "pages", OWN, (), NOW)
    key_path = made.authority.with_name("ca.key")
    authority = certificates.CertificateAuthority(
        certificates.read_certificate(made.authority.read_bytes(), made.authority),
        certificates.read_key(key_path.read_bytes(), key_path),
    )
    key = certificates.new_key()
    forged = certificates.issue_page(authority, ["bank.example"], key, NOW + timedelta(days=9), NOW)
    made.certificate.write_bytes(certificates.certificate_pem(forged))
    made.key.write_bytes(certificates.key_pem(key))
    with pytest.raises(ssl.SSLCertVerificationError, match="permitted subtree"):
        handshake(made, "bank.example")


def test_a_certificate_is_kept_while_it_fits(tmp_path: Path) -> None:
    folder = tmp_path / "keys" / "pages"
    first = page_certificate(folder, OWN, (), NOW)
    content, authority = first.certificate.read_bytes(), first.authority.read_bytes()
    assert page_certificate(folder, OWN[:2], (), NOW).certificate.read_bytes() == content
    page_certificate(folder, [*OWN, "10.0.0.9"], (), NOW)
    assert first.certificate.read_bytes() != content, "another address"
    content = first.certificate.read_bytes()
    page_certificate(folder, OWN, (), NOW + timedelta(days=PAGE_DAYS - 30))
    assert first.certificate.read_bytes() != content, "it soon expires"
    assert first.authority.read_bytes() == authority, "browsers need no new authority"
    page_certificate(folder, OWN, (), NOW + timedelta(days=1800))
    assert first.authority.read_bytes() != authority, "the authority expires, too"
    made = page_certificate(folder, OWN, (), NOW + timedelta(days=1800))
    handshake_names = certificates.page_names(
        certificates.read_certificate(made.certificate.read_bytes(), made.certificate)
    )
    assert set(handshake_names) == set(OWN)


def test_names_that_the_authority_may_not_certify_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "keys" / "pages"
    with pytest.raises(UsageError, match=r"none of 8\.8\.8\.8 is private"):
        page_certificate(folder, ["8.8.8.8"], (), NOW)
    page_certificate(folder, OWN, (), NOW)
    with pytest.raises(UsageError, match=r"drones.lab can't be certified .* --tls-cert"):
        page_certificate(folder, OWN, ["drones.lab"], NOW)
    shutil.rmtree(folder)
    assert page_certificate(folder, OWN, ["drones.lab"], NOW).left_out == ()
