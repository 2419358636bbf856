"""Certificates of a plant: an authority, and one for each role of a cell, person or application (X.509)."""

import os
import secrets
from collections.abc import Container, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Literal, get_args

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from armident.configs import ConfigError, DataError
from armident.configs.reasons import reason_of

Role = Literal["capture", "worker", "operator", "viewer", "router", "opcua"]
ROLES: tuple[Role, ...] = get_args(Role)
ANY_CELL = "*"
"""Cell of a router, of an application of OPC UA, and of an operator or viewer of the whole plant."""
TOLERANCE = timedelta(minutes=5)
"""Difference of the clocks of two hosts that a new certificate allows for."""
APPLICATION = "urn:"
"""Begin of an address that is the URI of an application of OPC UA."""
REVOKED = "authority.crl"
"""Name of the revocation list beside ``authority.pem``."""
RSA_BITS = 3072
"""Length of an RSA key, as strong as the curve P-256 (NIST SP 800-57)."""

PrivateKey = ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey
"""Key of P-256, or of RSA for role ``opcua``: the usual security policies of OPC UA know nothing else."""
_KEYS = (ec.EllipticCurvePublicKey, rsa.RSAPublicKey)
"""Kinds of keys of the other roles, and of role ``opcua``."""


@dataclass(frozen=True)
class Identity:
    """A role in a cell, or `ANY_CELL`, with key and certificate; ``name``: ``ROLE.CELL`` or ``ROLE.PERSON``."""

    role: Role
    cell: str
    name: str
    key: PrivateKey
    certificate: x509.Certificate

    def sign(self, data: bytes) -> bytes:
        """Return the signature of data: ECDSA with SHA-256, DER; an application of OPC UA signs nothing else."""
        assert isinstance(self.key, ec.EllipticCurvePrivateKey)
        return self.key.sign(data, ec.ECDSA(SHA256()))


@dataclass(frozen=True)
class Authority:
    """Certificate authority of a plant."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate

    def issue(
        self, role: Role, cell: str, name: str, addresses: Sequence[str], days: int, now: datetime | None = None
    ) -> Identity:
        """Return a new identity; ``addresses``: DNS names, IP addresses and URI of an application (`APPLICATION`).

        The certificate has the role as organisational unit and the cell as organisation. ConfigError if one is invalid.
        """
        if role not in ROLES or (cell == ANY_CELL and role in ("capture", "worker")):
            of_all = "capture and worker are of one cell"
            raise ConfigError(f"role {role!r} in cell {cell!r}: expected one of {', '.join(ROLES)}; {of_all}")
        key: PrivateKey = ec.generate_private_key(ec.SECP256R1())
        if role == "opcua":
            key = rsa.generate_private_key(65_537, RSA_BITS)
            if not any(address.startswith(APPLICATION) for address in addresses):
                addresses = [f"{APPLICATION}armident:{name}", *addresses]
        addressed = [_address(address) for address in addresses]
        more: list[tuple[x509.ExtensionType, bool]] = [
            (x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]), False),
            (x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), False),
            *([(x509.SubjectAlternativeName(addressed), False)] if addressed else []),
        ]
        subject = {NameOID.COMMON_NAME: name, NameOID.ORGANIZATIONAL_UNIT_NAME: role, NameOID.ORGANIZATION_NAME: cell}
        builder = _builder(subject, key, days, now, None, more).issuer_name(self.certificate.subject)
        return Identity(role, cell, name, key, builder.sign(self.key, SHA256()))

    def revocation_list(self, revoked: Iterable[x509.Certificate]) -> bytes:
        """Return the list of revoked certificates as PEM (RFC 5280, section 5), valid as long as the authority."""
        now = datetime.now(UTC)
        builder = (
            x509.CertificateRevocationListBuilder(self.certificate.subject, now, self.certificate.not_valid_after_utc)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), False)
            .add_extension(x509.CRLNumber(int(now.timestamp())), False)
        )
        for each in revoked:
            builder = builder.add_revoked_certificate(x509.RevokedCertificateBuilder(each.serial_number, now).build())
        return builder.sign(self.key, SHA256()).public_bytes(Encoding.PEM)


def new_authority(plant: str, days: int, now: datetime | None = None) -> Authority:
    """Return a new authority of a plant; its certificate signs itself, and no other authority."""
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder({NameOID.COMMON_NAME: plant}, key, days, now, 0, [])
    return Authority(key, builder.issuer_name(_name({NameOID.COMMON_NAME: plant})).sign(key, SHA256()))


def identity_of(certificate: x509.Certificate) -> tuple[Role, str, str]:
    """Return role, cell and name in a certificate; DataError if it has none."""
    try:
        name, unit, cell = (
            str(certificate.subject.get_attributes_for_oid(oid)[0].value)
            for oid in (NameOID.COMMON_NAME, NameOID.ORGANIZATIONAL_UNIT_NAME, NameOID.ORGANIZATION_NAME)
        )
        role = next(role for role in ROLES if role == unit)
    except (IndexError, StopIteration, TypeError, ValueError) as error:
        raise DataError("a certificate without role and cell") from error
    return role, cell, name


def trusted_certificate(
    certificate_der: bytes,
    authority_certificates: Iterable[x509.Certificate],
    at: datetime,
    revoked: Container[int] = (),
) -> x509.Certificate:
    """Return a certificate that one of the authorities issued and that is valid and not ``revoked``; else DataError."""
    try:
        certificate = x509.load_der_x509_certificate(certificate_der)
    except (ValueError, TypeError, UnsupportedAlgorithm, x509.InvalidVersion) as error:
        raise DataError("not a certificate (X.509, DER)") from error
    name = identity_of(certificate)[2]
    for authority in authority_certificates:
        with suppress(InvalidSignature, ValueError, TypeError, UnsupportedAlgorithm):
            certificate.verify_directly_issued_by(authority)
            break
    else:
        raise DataError(f"{name!r}: its certificate was issued by another authority")
    if not isinstance(certificate.public_key(), _KEYS[identity_of(certificate)[0] == "opcua"]):
        raise DataError(f"{name}: the certificate has another kind of key than its role")
    if certificate.serial_number in revoked:
        raise DataError(f"{name}: the certificate was revoked")
    check_dates(certificate, at, name)
    check_dates(authority, at, "the authority")
    return certificate


def verify(certificate: x509.Certificate, signature: bytes, data: bytes) -> None:
    """Check the signature of data by the holder of a trusted certificate; DataError if it is wrong."""
    key = certificate.public_key()
    try:
        if not isinstance(key, ec.EllipticCurvePublicKey):
            raise InvalidSignature
        key.verify(signature, data, ec.ECDSA(SHA256()))
    except InvalidSignature as error:
        raise DataError(f"the signature of {identity_of(certificate)[2]} does not fit: changed or forged") from error


def check_dates(certificate: x509.Certificate, at: datetime, name: str) -> None:
    """Check that a certificate is valid at a time; DataError with its ``name`` and the date if not."""
    if at > certificate.not_valid_after_utc:
        raise DataError(f"{name}: the certificate expired on {certificate.not_valid_after_utc:%Y-%m-%d}")
    if at < certificate.not_valid_before_utc:
        begin = certificate.not_valid_before_utc
        raise DataError(f"{name}: the certificate is valid from {begin:%Y-%m-%d %H:%M} UTC; check the clock")


def pem_of(*certificates: x509.Certificate) -> bytes:
    """Return certificates as PEM."""
    return b"".join(certificate.public_bytes(Encoding.PEM) for certificate in certificates)


def write_key(path: Path, key: PrivateKey, mode: int = 0o600) -> None:
    """Write a private key as PEM (PKCS 8); mode 0640: its group may read it."""
    write_whole(path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), mode)


def write_identity(folder: Path, identity: Identity) -> None:
    """Write ``NAME.key`` and then ``NAME.pem``, by which readers find an identity."""
    write_key(folder / f"{identity.name}.key", identity.key)
    write_whole(folder / f"{identity.name}.pem", pem_of(identity.certificate), 0o644)


def write_whole(path: Path, content: bytes, mode: int) -> None:
    """Write a file so that a reader sees all of it or none of it; ConfigError if the folder may not be written."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with open(temporary, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as stream:
            os.fchmod(stream.fileno(), mode)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {reason_of(error, named=False, step=True)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def read_certificates(path: Path) -> tuple[x509.Certificate, ...]:
    """Return the certificates of a PEM file; ConfigError if it has none."""
    try:
        return tuple(x509.load_pem_x509_certificates(path.read_bytes()))
    except OSError as error:
        raise ConfigError(reason_of(error)) from error
    except ValueError as error:
        raise ConfigError(f"{path}: expected certificates (PEM)") from error


def read_key(path: Path) -> PrivateKey:
    """Return the private key of a PEM file; ConfigError if it is none, or if all users may read it."""
    try:
        if path.stat().st_mode & 0o007:
            raise ConfigError(f"{path}: other users may read this private key; run: chmod o= {path}")
        key = load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        raise ConfigError(reason_of(error)) from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise ConfigError(f"{path}: expected a private key without password (PEM)") from error
    if not isinstance(key, PrivateKey):
        raise ConfigError(f"{path}: expected a key of the curve P-256, or of RSA")
    return key


def read_identity(path: Path) -> Identity:
    """Return the identity of ``NAME.pem`` with its key beside it; ConfigError if one is missing or invalid."""
    certificate, key = read_certificates(path)[0], read_key(path.with_suffix(".key"))
    if certificate.public_key() != key.public_key():
        raise ConfigError(f"{path}: the certificate does not belong to the key beside it")
    try:
        role, cell, name = identity_of(certificate)
    except DataError as error:
        raise ConfigError(f"{path}: {error}") from error
    return Identity(role, cell, name, key, certificate)


def read_authority(folder: Path) -> Authority:
    """Return the authority whose key is in a folder; ConfigError if there is none."""
    if not (folder / "authority.key").is_file():
        raise ConfigError(
            f"{folder / 'authority.key'}: no such file; run this where the authority of the plant is kept"
        )
    key = read_key(folder / "authority.key")
    for certificate in read_certificates(folder / "authority.pem"):
        if isinstance(key, ec.EllipticCurvePrivateKey) and certificate.public_key() == key.public_key():
            return Authority(key, certificate)
    raise ConfigError(f"{folder / 'authority.pem'}: no certificate belongs to authority.key")


def _builder(
    subject: dict[x509.ObjectIdentifier, str],
    key: PrivateKey,
    days: int,
    now: datetime | None,
    path_length: int | None,
    more: list[tuple[x509.ExtensionType, bool]],
) -> x509.CertificateBuilder:
    """Return a certificate without issuer; ``path_length``: of an authority, ``None`` of a role."""
    begin, ca = now or datetime.now(UTC), path_length is not None
    builder = (
        x509.CertificateBuilder(subject_name=_name(subject), public_key=key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin - TOLERANCE)
        .not_valid_after(begin + timedelta(days=days))
    )
    # OPC 10000-6, 6.2.2: an application signs, and receives keys that are encrypted.
    uses = isinstance(key, rsa.RSAPrivateKey)
    usage = x509.KeyUsage(not ca, uses, uses, uses, False, ca, ca, False, False)
    own = [(x509.BasicConstraints(ca, path_length), True), (usage, True)]
    for extension, critical in (*own, (x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False), *more):
        builder = builder.add_extension(extension, critical)
    return builder


def _name(attributes: dict[x509.ObjectIdentifier, str]) -> x509.Name:
    try:
        return x509.Name([x509.NameAttribute(oid, value) for oid, value in attributes.items()])
    except ValueError as error:
        values = ", ".join(map(repr, attributes.values()))
        raise ConfigError(f"{values}: names in certificates have 1 to 64 characters") from error


def _address(text: str) -> x509.GeneralName:
    with suppress(ValueError):
        return x509.IPAddress(ip_address(text))
    try:
        return x509.UniformResourceIdentifier(text) if text.startswith(APPLICATION) else x509.DNSName(text)
    except ValueError as error:
        raise ConfigError(f"address {text!r}: expected an IP address or a DNS name in ASCII") from error
