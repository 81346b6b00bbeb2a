"""A small certificate authority for one rig: who may join from another host, and as what.

A certificate's common name is ``<role>.<host>``: all that a router goes by. Elliptic curve P-256 throughout.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.hosts import Role, common_name
from endo3d.services.runtime.identity import AUTHORITY

_HERE: Final = ("127.0.0.1", "localhost")
"""A router is also reached from its own host."""
_EARLIER: Final = timedelta(hours=1)
"""Valid a little before now: the clocks of two hosts differ."""


def make_authority(folder: Path, rig: str, days: int) -> Path:
    """``ca.pem`` and ``ca.key`` in ``folder``; returns the certificate. Raises ``UserError`` if there is one."""
    certificate, key = folder / f"{AUTHORITY}.pem", folder / f"{AUTHORITY}.key"
    if certificate.exists() or key.exists():
        raise UserError(f"{folder} has an authority already; every certificate it signed would be void: choose another")
    private = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"endo3d {rig}"[:64])])
    signed = (
        _unsigned(name, name, private.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(private.public_key()), critical=False)
        .sign(private, hashes.SHA256())
    )
    _make_private(folder)
    _write(key, _pem(private), 0o600)
    _write(certificate, signed.public_bytes(serialization.Encoding.PEM), 0o644)
    return certificate


def make_host(authority: Path, folder: Path, host: str, role: Role, addresses: Sequence[str], days: int) -> Path:
    """``<host>.pem``, ``<host>.key`` and ``ca.pem`` in ``folder``, signed by the authority in ``authority``.

    addresses: where others reach this host, names or numbers. Raises ``UserError``.
    """
    try:
        ca = x509.load_pem_x509_certificate((authority / f"{AUTHORITY}.pem").read_bytes())
        ca_key = serialization.load_pem_private_key((authority / f"{AUTHORITY}.key").read_bytes(), password=None)
    except (OSError, ValueError) as error:
        raise UserError(f"no authority in {authority} ({error}); make one: endo3d keys init") from None
    assert isinstance(ca_key, ec.EllipticCurvePrivateKey)
    certificate, key = folder / f"{host}.pem", folder / f"{host}.key"
    if certificate.exists() or key.exists():
        raise UserError(f"{folder} has a certificate of {host} already; remove it first, or choose another folder")
    private = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name(role, host))])
    names = [_general_name(address) for address in dict.fromkeys((host, *addresses, *_HERE))]
    signed = (
        _unsigned(subject, ca.subject, private.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]), critical=False
        )
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key()), critical=False)
        .sign(ca_key, hashes.SHA256())
    )
    _make_private(folder)
    _write(key, _pem(private), 0o600)
    _write(certificate, signed.public_bytes(serialization.Encoding.PEM), 0o644)
    if folder != authority:
        _write(folder / f"{AUTHORITY}.pem", ca.public_bytes(serialization.Encoding.PEM), 0o644)
    return certificate


def name_in(certificate: Path) -> tuple[str, datetime]:
    """A certificate's common name and the end of its validity. Raises ``UserError``."""
    try:
        read = x509.load_pem_x509_certificate(certificate.read_bytes())
        name = read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value
    except (OSError, ValueError, IndexError) as error:
        raise UserError(f"{certificate} is no certificate of endo3d ({error}); make one: endo3d keys host") from None
    return str(name), read.not_valid_after_utc


def _unsigned(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + timedelta(days=days))
    )


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _make_private(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)


def _write(path: Path, content: bytes, mode: int) -> None:
    """Never readable by others, not even for a moment."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(descriptor, mode)
        file.write(content)
