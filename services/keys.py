"""`suturetrack keys`: a private certificate authority, certificates for the roles, configurations."""

from __future__ import annotations

import datetime
import ipaddress
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from rich.console import Console
from rich.table import Table

from services import access
from services.checks import check_rig
from suturetrack.types import InputError

_CLOSED = {"scouting/multicast/enabled": False, "scouting/gossip/enabled": False}
_DAY = datetime.timedelta(days=1)


@dataclass(frozen=True)
class KeysConfig:
    """`keys init DIR` makes a certificate authority, a certificate for each role, and configurations
    with mutual TLS and access rules: DIR/router.json5, and DIR/RIG-ROLE.json5 for --zenoh."""

    action: tyro.conf.Positional[Literal["init"]]
    """What to do."""
    directory: tyro.conf.Positional[Path]
    """The folder to make; it must not hold keys yet."""
    router: str = "localhost"
    """Name or address under which every host reaches the router."""
    port: int = 7447
    """The router's port."""
    rigs: tuple[str, ...] = ("rig",)
    """Names of the rigs that the router serves."""
    days: int = 365
    """How long the certificates hold."""


def run(config: KeysConfig) -> None:
    """Makes what was asked for; raises InputError."""
    made = init(config)
    table = Table("file", "for", title=f"Keys in {config.directory}", title_justify="left")
    for name, purpose in made.items():
        table.add_row(name, purpose)
    console = Console()
    console.print(table)
    console.print(
        "Give each host the files of its roles alone. ca-key.pem makes new certificates: keep it off "
        "every host that runs."
    )


def init(config: KeysConfig) -> dict[str, str]:
    """Writes keys and configurations; the configurations' names and what each is for.

    Raises:
        InputError: a name or number is impossible, or the folder holds keys or cannot be written.
    """
    _check(config)
    folder = config.directory
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if any(folder.glob("*.pem")):
            raise InputError(f"keys {folder}: it holds keys already; name another folder")
        authority = Authority(config.days)
        _write(folder / "ca-key.pem", _key_bytes(authority.key))
        _write(folder / "ca.pem", _certificate_bytes(authority.certificate))
        endpoint = f"tls/{config.router}:{config.port}"
        made = {"router.json5": "the router: suturetrack router --zenoh"}
        _issue(authority, folder, access.ROUTER, config.router)
        settings = _router_settings(folder, config)
        _write_config(folder / "router.json5", settings)
        for rig in config.rigs:
            for role in access.ROLES.values():
                name = access.common_name(rig, role.name)
                _issue(authority, folder, name)
                _write_config(folder / f"{name}.json5", _role_settings(folder, rig, role, endpoint))
                made[f"{name}.json5"] = f"{role.purpose}: --rig {rig} --zenoh"
    except OSError as error:
        raise InputError(f"keys {folder}: {error.strerror or error}") from error
    return made


class Authority:
    """A private certificate authority."""

    def __init__(self, days: int):
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.days = days
        name = _name("suturetrack authority")
        builder = _builder(name, self.key.public_key(), days).issuer_name(name)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), True)
        self.certificate = builder.sign(self.key, hashes.SHA256())

    def issue(
        self, common_name: str, host: str | None = None
    ) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
        """A key and a certificate; `host` is the name or address that others connect to."""
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _builder(_name(common_name), key.public_key(), self.days)
        builder = builder.issuer_name(self.certificate.subject)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
        usage = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
        builder = builder.add_extension(x509.ExtendedKeyUsage(usage), False)
        name = _alternative(host or common_name)
        builder = builder.add_extension(x509.SubjectAlternativeName([name]), False)
        return key, builder.sign(self.key, hashes.SHA256())


def _check(config: KeysConfig) -> None:
    if not config.rigs:
        raise InputError("keys: name one or more --rigs")
    for rig in config.rigs:
        check_rig(rig)
    if not 1 <= config.port <= 65535:
        raise InputError(f"port {config.port}: use 1 to 65535")
    if not 1 <= config.days <= 3650:
        raise InputError(f"days {config.days}: use 1 to 3650")


def _router_settings(folder: Path, config: KeysConfig) -> dict[str, Any]:
    return {
        "mode": "router",
        **_CLOSED,
        "listen/endpoints": [f"tls/[::]:{config.port}"],
        "connect/endpoints": [],
        "transport/link/tls": _tls(folder, access.ROUTER),
        "access_control": access.router_rules(config.rigs),
    }


def _role_settings(folder: Path, rig: str, role: access.Role, endpoint: str) -> dict[str, Any]:
    return {
        # A client talks to its router alone: peers would find ways around the router's rules.
        "mode": "client",
        **_CLOSED,
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "transport/link/tls": _tls(folder, access.common_name(rig, role.name)),
        "access_control": access.process_rules(rig, role),
    }


def _tls(folder: Path, name: str) -> dict[str, Any]:
    folder = folder.resolve()
    files = {"private_key": folder / f"{name}-key.pem", "certificate": folder / f"{name}.pem"}
    return {
        "root_ca_certificate": str(folder / "ca.pem"),
        "enable_mtls": True,
        "close_link_on_expiration": True,
        **{
            f"{side}_{what}": str(file)
            for side in ("listen", "connect")
            for what, file in files.items()
        },
    }


def _issue(authority: Authority, folder: Path, name: str, host: str | None = None) -> None:
    key, certificate = authority.issue(name, host)
    _write(folder / f"{name}-key.pem", _key_bytes(key))
    _write(folder / f"{name}.pem", _certificate_bytes(certificate))


def _builder(name: x509.Name, key: ec.EllipticCurvePublicKey, days: int) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        # Hosts' clocks may be apart.
        .not_valid_before(now - _DAY)
        .not_valid_after(now + days * _DAY)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _key_bytes(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _certificate_bytes(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _write(path: Path, content: bytes) -> None:
    """Writes a file that only this user may read; never over another."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)


def _write_config(path: Path, settings: dict[str, Any]) -> None:
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        *outer, last = key.split("/")
        place = nested
        for part in outer:
            place = place.setdefault(part, {})
        place[last] = value
    _write(path, (json.dumps(nested, indent=1) + "\n").encode())
