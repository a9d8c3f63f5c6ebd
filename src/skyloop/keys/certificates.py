"""Certificates (X.509) of a lab's authority and of its identities: made, read, checked. Times are arguments, in UTC.

An identity's common name is its name, by which Zenoh's access control knows it. What it may do stands in a URI among
its alternative names, ``urn:skyloop:ROLE:DRONES``. Only proxies and routers may use theirs to be connected to (extended
key usage), so that with the key of a pilot or an observer nobody can stand in for a proxy.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from skyloop.errors import FileFormatError, MissingExtraError, UsageError
from skyloop.keys.identity import Identity, KeyRole, make_identity

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:  # pragma: no cover  it is installed where tests run
    raise MissingExtraError("keys", "network", cause=str(error)) from None

PrivateKey = ec.EllipticCurvePrivateKey

#: Certificates count from a day ago, for machines whose clocks are behind.
BACKDATED: Final = timedelta(days=1)
_URN: Final = "urn:skyloop:"
_CURVE: Final = ec.SECP256R1()
_SIGNED: Final = ec.ECDSA(hashes.SHA256())


@dataclass(frozen=True, slots=True)
class Authority:
    """A lab's authority. ``key`` is there only where identities are issued."""

    certificate: x509.Certificate
    key: PrivateKey | None = None

    @property
    def name(self) -> str:
        return common_name(self.certificate)

    @property
    def expires(self) -> datetime:
        return self.certificate.not_valid_after_utc

    def sign(self, content: bytes) -> bytes:
        """A signature of something that is no certificate."""
        assert self.key is not None
        return self.key.sign(content, _SIGNED)

    def signed(self, content: bytes, signature: bytes) -> bool:
        """Whether the signature is this authority's."""
        try:
            _public(self.certificate).verify(signature, content, _SIGNED)
        except InvalidSignature:
            return False
        return True


def new_key() -> PrivateKey:
    """A new private key."""
    return ec.generate_private_key(_CURVE)


def key_pem(key: PrivateKey) -> bytes:
    """A private key as it is kept in a file."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def certificate_pem(certificate: x509.Certificate) -> bytes:
    """A certificate as it is kept in a file."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def make_authority(days: int, now: datetime) -> Authority:
    """A new lab's authority, valid for so many days. Its name ends in random digits, so that labs can be told apart."""
    key = new_key()
    name = _name(f"Skyloop lab {secrets.token_hex(4)}")
    certificate = (
        _builder(name, name, key, now, now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Authority(certificate, key)


def issue(
    authority: Authority, identity: Identity, key: PrivateKey, until: datetime, now: datetime
) -> x509.Certificate:
    """A certificate for an identity. It never lasts longer than the authority's own."""
    assert authority.key is not None
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if identity.role in (KeyRole.PROXY, KeyRole.ROUTER):
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    issuer = authority.certificate
    end = min(until, issuer.not_valid_after_utc)
    urn = x509.UniformResourceIdentifier(f"{_URN}{identity.role}:{','.join(identity.drones)}")
    return (
        _builder(_name(identity.name), issuer.subject, key, now, end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=True)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(_public(issuer)), critical=False)
        .add_extension(x509.SubjectAlternativeName([urn]), critical=False)
        .sign(authority.key, hashes.SHA256())
    )


def read_certificate(content: bytes, path: Path) -> x509.Certificate:
    """Raises :class:`FileFormatError`; ``path`` is named in it."""
    try:
        return x509.load_pem_x509_certificate(content)
    except ValueError:
        raise FileFormatError(f"{path} is no certificate in PEM form, or it is damaged") from None


def read_key(content: bytes, path: Path) -> PrivateKey:
    """Raises :class:`FileFormatError`."""
    try:
        key = serialization.load_pem_private_key(content, password=None)
    except (ValueError, TypeError):  # TypeError: it is encrypted
        raise FileFormatError(f"{path} is no unencrypted private key in PEM form, or it is damaged") from None
    if not isinstance(key, PrivateKey):
        raise FileFormatError(f"{path} holds a key of another kind than skyloop keys makes: it must be one on a curve")
    return key


def read_authority(certificate: x509.Certificate, key: PrivateKey | None, path: Path) -> Authority:
    """Raises :class:`FileFormatError` for what is no authority that skyloop keys made."""
    try:
        constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
    except x509.ExtensionNotFound:
        constraints = x509.BasicConstraints(ca=False, path_length=None)
    if not constraints.ca or not isinstance(certificate.public_key(), ec.EllipticCurvePublicKey):
        raise FileFormatError(f"{path} is not the certificate of an authority that skyloop keys init made")
    if key is not None and not matches(key, certificate):
        raise UsageError(f"the key of the authority does not belong to its certificate {path}")
    return Authority(certificate, key)


def identity_of(certificate: x509.Certificate, path: Path) -> Identity:
    """Who a certificate says its holder is. Raises :class:`FileFormatError`."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        (urn,) = (uri for uri in names.get_values_for_type(x509.UniformResourceIdentifier) if uri.startswith(_URN))
        role, drones = urn.removeprefix(_URN).split(":")
        return make_identity(common_name(certificate), role, drones)
    except (x509.ExtensionNotFound, ValueError) as error:
        raise FileFormatError(
            f"{path} was not made by skyloop keys issue: it names no role and drones ({error})"
        ) from None


def common_name(certificate: x509.Certificate) -> str:
    """The name that access control goes by; empty if there is none, or several."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if len(names) == 1 else ""


def matches(key: PrivateKey, certificate: x509.Certificate) -> bool:
    """Whether the certificate is about this key."""
    return key.public_key() == certificate.public_key()


def check_issued(certificate: x509.Certificate, authority: Authority, path: Path) -> None:
    """Raise :class:`UsageError` for a certificate that another authority issued."""
    try:
        certificate.verify_directly_issued_by(authority.certificate)
    except (ValueError, TypeError, InvalidSignature):
        raise UsageError(
            f"{path} was not issued by the authority beside it, {authority.name}: keys of different labs were mixed"
        ) from None


def check_time(certificate: x509.Certificate, what: str, now: datetime) -> None:
    """Raise :class:`UsageError` for a certificate that is not valid yet, or no longer."""
    if now >= certificate.not_valid_after_utc:
        raise UsageError(f"{what} expired on {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC: issue a new one")
    if now < certificate.not_valid_before_utc:
        raise UsageError(
            f"{what} is valid from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC on, and this machine's clock "
            f"says {now:%Y-%m-%d %H:%M}: set the clock"
        )


def _public(certificate: x509.Certificate) -> ec.EllipticCurvePublicKey:
    public = certificate.public_key()
    assert isinstance(public, ec.EllipticCurvePublicKey)  # seen to by read_authority
    return public


def _builder(
    subject: x509.Name, issuer: x509.Name, key: PrivateKey, now: datetime, end: datetime
) -> x509.CertificateBuilder:
    public = key.public_key()
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )
