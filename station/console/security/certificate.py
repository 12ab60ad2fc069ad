"""A self-signed certificate for a console on the shop's own network."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from station.core.files import private_folder, write_bytes

CERTIFICATE, KEY = "certificate.pem", "key.pem"
_DAYS = 825
"""The longest that Apple's devices accept (support.apple.com/103769)."""
_EVERY = ("0.0.0.0", "::")
"""Addresses of console.host that stand for all of the machine's."""


def reached_by(names: Sequence[str]) -> list[str]:
    """The host's names and addresses, and those given, by which browsers reach it."""
    import psutil

    host = socket.gethostname()
    found = [host, f"{host}.local", "localhost", "127.0.0.1", *names]
    for interface in psutil.net_if_addrs().values():
        inet = [one for one in interface if one.family in (socket.AF_INET, socket.AF_INET6)]
        # A link-local address is typed with the link's name, which no certificate can hold.
        found += [one.address for one in inet if "%" not in one.address]
    return [name for name in dict.fromkeys(found) if name not in _EVERY]


def make_certificate(folder: Path, names: Sequence[str]) -> Path:
    """Write `certificate.pem` and `key.pem` for a host's names and addresses; return the first.

    The key is P-256 and readable by its owner alone.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    host = socket.gethostname()[:64]
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, host)])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(days=_DAYS))
        .add_extension(x509.SubjectAlternativeName([_name(name) for name in names]), False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
        .sign(key, hashes.SHA256())
    )
    private_folder(folder)
    secret = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    public = certificate.public_bytes(serialization.Encoding.PEM)
    for name, content in ((KEY, secret), (CERTIFICATE, public)):
        write_bytes(folder / name, content, private=True)
    return folder / CERTIFICATE


def _name(name: str):  # type: ignore[no-untyped-def]  # its type needs the lazy import
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)
