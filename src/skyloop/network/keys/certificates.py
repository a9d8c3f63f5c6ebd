"""Create, read and check X.509 certificates of a lab's authority and identities. Times are passed as arguments, in UTC.

The certificate's common name is the identity's name, which Zenoh's access control uses. The identity's role and drones
are in the URI ``urn:skyloop:ROLE:DRONES`` among the alternative names. Only certificates of proxies and routers may
accept connections (extended key usage), so that nobody can impersonate a proxy with the key of a pilot or an observer.
"""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from skyloop.errors import DecodeError, FileFormatError, MissingExtraError, UsageError
from skyloop.network.keys.identity import Identity, KeyRole, make_identity

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:  # always installed where the tests run
    raise MissingExtraError("keys", "network", cause=str(error)) from None

PrivateKey = ec.EllipticCurvePrivateKey
Certificate = x509.Certificate

#: Certificates are valid from the day before they are issued, for machines whose clocks are slow.
BACKDATED: Final = timedelta(days=1)
#: What a page authority may certify: private networks (RFC 1918, 4193, 3927, 6598), this machine …
PAGE_NETWORKS: Final = (
    *("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16", "100.64.0.0/10", "127.0.0.0/8"),
    *("fc00::/7", "fe80::/10", "::1/128"),
)
#: … and names that do not exist on the Internet (RFC 6762, 8375; ICANN has reserved ``.internal``).
PAGE_NAMES: Final = ("localhost", "local", "lan", "internal", "home.arpa")
_URN: Final = "urn:skyloop:"
_CURVE: Final = ec.SECP256R1()
_SIGNED: Final = ec.ECDSA(hashes.SHA256())


@dataclass(frozen=True, slots=True)
class CertificateAuthority:
    """A lab's authority. ``key`` is set only where identities are issued."""

    certificate: x509.Certificate
    key: PrivateKey | None = None

    @property
    def name(self) -> str:
        return common_name(self.certificate)

    @property
    def expires(self) -> datetime:
        """When the authority's certificate expires, in UTC."""
        return self.certificate.not_valid_after_utc

    def sign(self, content: bytes) -> bytes:
        """Return a signature of content that is not a certificate."""
        assert self.key is not None
        return self.key.sign(content, _SIGNED)

    def signed(self, content: bytes, signature: bytes) -> bool:
        """Return whether a signature of content was made by this authority."""
        return signed_by(self.certificate, content, signature)


def new_key() -> PrivateKey:
    """Create a new private key on the curve P-256."""
    return ec.generate_private_key(_CURVE)


def key_pem(key: PrivateKey) -> bytes:
    """Encode a private key for a file: unencrypted PKCS #8 in PEM."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def certificate_pem(certificate: x509.Certificate) -> bytes:
    """Encode a certificate for a file, in PEM."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def make_authority(days: int, now: datetime) -> CertificateAuthority:
    """Create the authority of a new lab. Its name ends in random digits to tell labs apart."""
    return _self_signed(f"Skyloop lab {secrets.token_hex(4)}", days, now)


def issue(
    authority: CertificateAuthority, identity: Identity, key: PrivateKey, until: datetime, now: datetime
) -> x509.Certificate:
    """Create a certificate for an identity, signed with the authority's key and valid no longer than that."""
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if identity.role in (KeyRole.PROXY, KeyRole.ROUTER):
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    urn = x509.UniformResourceIdentifier(f"{_URN}{identity.role}:{','.join(identity.drones)}")
    return _issued(authority, identity.name, key, until, now, purposes, [urn])


def make_page_authority(names: Sequence[str], days: int, now: datetime) -> CertificateAuthority:
    """Create an authority for pages, separate from the lab's. It may certify only these names and names below them.

    Its certificates are valid for private addresses, names on local networks, and the names given on creation. A
    browser that trusts it does not trust it for any other site (name constraints, RFC 5280, 4.2.1.10).
    """
    permitted: list[x509.GeneralName] = [x509.IPAddress(ipaddress.ip_network(network)) for network in PAGE_NETWORKS]
    permitted += [x509.DNSName(each) for each in dict.fromkeys([*PAGE_NAMES, *names])]
    return _self_signed(f"Skyloop pages {secrets.token_hex(4)}", days, now, x509.NameConstraints(permitted, None))


def issue_page(
    authority: CertificateAuthority, names: Sequence[str], key: PrivateKey, until: datetime, now: datetime
) -> x509.Certificate:
    """Create a certificate for a cockpit's page, reached by these IP addresses and host names; see :func:`issue`."""
    reached = [_general_name(each) for each in names]
    return _issued(authority, "Skyloop cockpit", key, until, now, [ExtendedKeyUsageOID.SERVER_AUTH], reached)


def page_names(certificate: x509.Certificate) -> list[str]:
    """Return the addresses and names that a page's certificate contains."""
    found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return [*map(str, found.get_values_for_type(x509.IPAddress)), *found.get_values_for_type(x509.DNSName)]


def may_certify(authority: CertificateAuthority, name: str) -> bool:
    """Return whether a page authority may certify an address or a name."""
    permitted = authority.certificate.extensions.get_extension_for_class(x509.NameConstraints).value.permitted_subtrees
    wanted = _general_name(name)
    if isinstance(wanted, x509.DNSName):
        domains = [one.value for one in permitted or () if isinstance(one, x509.DNSName)]
        return any(wanted.value == domain or wanted.value.endswith(f".{domain}") for domain in domains)
    networks = [ipaddress.ip_network(str(one.value)) for one in permitted or () if isinstance(one, x509.IPAddress)]
    return any(ipaddress.ip_address(str(wanted.value)) in network for network in networks)


def read_certificate(content: bytes, path: Path) -> x509.Certificate:
    """Decode a certificate read from a file."""
    try:
        return x509.load_pem_x509_certificate(content)
    except ValueError:
        raise FileFormatError(f"{path} is not a certificate in PEM form, or is damaged") from None


def read_der(content: bytes) -> x509.Certificate:
    """Decode a certificate in DER that was received over the network."""
    try:
        return x509.load_der_x509_certificate(content)
    except ValueError as error:
        raise DecodeError(f"{len(content)} bytes are not a certificate: {error}") from None


def der(certificate: x509.Certificate) -> bytes:
    """Encode a certificate in DER, so that it can be sent over the network."""
    return certificate.public_bytes(serialization.Encoding.DER)


def sign(key: PrivateKey, content: bytes) -> bytes:
    """Sign content with an identity's key. The signature is ECDSA with SHA-256, in DER."""
    return key.sign(content, _SIGNED)


def signed_by(certificate: x509.Certificate, content: bytes, signature: bytes) -> bool:
    """Return whether the holder of a certificate signed this content."""
    public = certificate.public_key()
    if not isinstance(public, ec.EllipticCurvePublicKey):
        return False
    try:
        public.verify(signature, content, _SIGNED)
    except InvalidSignature:
        return False
    return True


def read_key(content: bytes, path: Path) -> PrivateKey:
    """Decode an elliptic-curve private key that was read from a file."""
    try:
        key = serialization.load_pem_private_key(content, password=None)
    except (ValueError, TypeError):  # an encrypted key raises TypeError
        raise FileFormatError(f"{path} is not an unencrypted private key in PEM form, or is damaged") from None
    if not isinstance(key, PrivateKey):
        raise FileFormatError(f"{path} is not a key made by skyloop keys: it must be on an elliptic curve")
    return key


def read_authority(certificate: x509.Certificate, key: PrivateKey | None, path: Path) -> CertificateAuthority:
    """Check that a certificate belongs to an authority. ``key`` is None on machines that issue no certificates."""
    try:
        constraints = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
    except x509.ExtensionNotFound:
        constraints = x509.BasicConstraints(ca=False, path_length=None)
    if not constraints.ca or not isinstance(certificate.public_key(), ec.EllipticCurvePublicKey):
        raise FileFormatError(f"{path} is not the certificate of an authority created by Skyloop")
    if key is not None and not matches(key, certificate):
        raise UsageError(f"the key of the authority does not belong to its certificate {path}")
    return CertificateAuthority(certificate, key)


def identity_of(certificate: x509.Certificate, path: Path) -> Identity:
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
    """Return the name that access control uses; empty if the certificate contains no name or several."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if len(names) == 1 else ""


def matches(key: PrivateKey, certificate: x509.Certificate) -> bool:
    return key.public_key() == certificate.public_key()


def check_issued(certificate: x509.Certificate, authority: CertificateAuthority, path: Path) -> None:
    try:
        certificate.verify_directly_issued_by(authority.certificate)
    except (ValueError, TypeError, InvalidSignature):
        raise UsageError(
            f"{path} was not issued by the authority beside it, {authority.name}: keys of different labs were mixed"
        ) from None


def check_time(certificate: x509.Certificate, what: str, now: datetime) -> None:
    if now >= certificate.not_valid_after_utc:
        raise UsageError(f"{what} expired on {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC: issue a new one")
    if now < certificate.not_valid_before_utc:
        raise UsageError(
            f"{what} is valid from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC on, and this machine's clock "
            f"shows {now:%Y-%m-%d %H:%M}: set the clock"
        )


def _general_name(name: str) -> x509.IPAddress | x509.DNSName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name.lower())


def _self_signed(title: str, days: int, now: datetime, *constraints: x509.ExtensionType) -> CertificateAuthority:
    key, name = new_key(), _name(title)
    builder = _builder(name, name, key, now, now + timedelta(days=days), authority=True)
    for constraint in constraints:
        builder = builder.add_extension(constraint, critical=True)
    return CertificateAuthority(builder.sign(key, hashes.SHA256()), key)


def _issued(
    authority: CertificateAuthority,
    title: str,
    key: PrivateKey,
    until: datetime,
    now: datetime,
    purposes: list[x509.ObjectIdentifier],
    names: Sequence[x509.GeneralName],
) -> x509.Certificate:
    assert authority.key is not None
    issuer = authority.certificate
    public = issuer.public_key()
    assert isinstance(public, ec.EllipticCurvePublicKey)  # read_authority has checked this
    return (
        _builder(_name(title), issuer.subject, key, now, min(until, issuer.not_valid_after_utc), authority=False)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=True)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(public), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .sign(authority.key, hashes.SHA256())
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, key: PrivateKey, now: datetime, end: datetime, *, authority: bool
) -> x509.CertificateBuilder:
    public = key.public_key()
    usage = x509.KeyUsage(
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
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
        .add_extension(x509.BasicConstraints(ca=authority, path_length=0 if authority else None), critical=True)
        .add_extension(usage, critical=True)
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])
