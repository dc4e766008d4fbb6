"""Makes an authority and a certificate for each role of a run, for trials.

DIR/ROLE holds what a process of that role needs, and no more:

    ca.pem           the authority's certificate, which verifies the others
    certificate.pem  its own certificate; the common name is the role
    key.pem          its private key

Invariants: valid files are left as they are; only their owner can read keys; only a router's
certificate is valid for a listener.
"""

import datetime
import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime.files import atomic_write
from mrcdrl.common.runtime.names import check_name

_LISTENING = ("router",)
_AUTHORITY = "ca"
_CERTIFICATE, _KEY = "certificate.pem", "key.pem"
_EARLIER = datetime.timedelta(hours=1)  # for peers whose clocks are slow


@dataclass(frozen=True, slots=True)
class Credentials:
    """A certificate and its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Read what `write` wrote; None if it is missing or has expired."""
        try:
            certificate = x509.load_pem_x509_certificate((folder / _CERTIFICATE).read_bytes())
            key = load_pem_private_key((folder / _KEY).read_bytes(), None)
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise ConfigError(f"{folder}: {error}; remove it to have it made again") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise ConfigError(f"{folder}: not made by mrcdrl certs")
        expired = certificate.not_valid_after_utc <= datetime.datetime.now(datetime.UTC)
        return None if expired else cls(certificate, key)

    def issued(self, certificate: x509.Certificate) -> bool:
        """Whether this authority issued the certificate."""
        try:
            certificate.verify_directly_issued_by(self.certificate)
        except (ValueError, TypeError, InvalidSignature):
            return False
        return True

    def write(self, folder: Path) -> None:
        """Write both files, the key first: a certificate always has its key."""
        folder.mkdir(parents=True, exist_ok=True)
        pem = self.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        atomic_write(folder / _KEY, pem, 0o600)
        atomic_write(folder / _CERTIFICATE, _pem(self.certificate), 0o644)


def make(
    folder: Path, roles: Iterable[str], hosts: Iterable[str], valid: datetime.timedelta
) -> list[str]:
    """Make the missing authority and certificates; return the names of those made.

    hosts: names and addresses that reach the router.
    """
    wanted = [check_name(role, "role") for role in roles]
    made = []
    authority = Credentials.read(folder / _AUTHORITY)
    if authority is None:
        authority = _authority(valid)
        authority.write(folder / _AUTHORITY)
        made.append(_AUTHORITY)
    for role in wanted:
        existing = Credentials.read(folder / role)
        if existing is None or not authority.issued(existing.certificate):
            (folder / role).mkdir(parents=True, exist_ok=True)
            atomic_write(folder / role / "ca.pem", _pem(authority.certificate), 0o644)
            _of_role(role, authority, hosts, valid).write(folder / role)
            made.append(role)
    return made


def _authority(valid: datetime.timedelta) -> Credentials:
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("mrcdrl trial authority")
    usage = _key_usage(signs_certificates=True)
    builder = (
        _builder(name, name, key.public_key(), valid)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    return Credentials(builder.sign(key, hashes.SHA256()), key)


def _of_role(
    role: str, authority: Credentials, hosts: Iterable[str], valid: datetime.timedelta
) -> Credentials:
    key = ec.generate_private_key(ec.SECP256R1())
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role in _LISTENING:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    builder = (
        _builder(_name(role), authority.certificate.subject, key.public_key(), valid)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.SubjectAlternativeName([_host(h) for h in hosts]), critical=False)
    )
    return Credentials(builder.sign(authority.key, hashes.SHA256()), key)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, valid: datetime.timedelta
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + valid)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)
