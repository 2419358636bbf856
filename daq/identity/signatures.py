"""Signatures of messages on Zenoh, in the attachment of a sample, a query or a reply; payloads stay as they are.

An attachment is ``ARMS``, version (u8), time (i64, ns UTC), lengths of nonce (u8) and certificate (u16), little endian;
then nonce, certificate (DER) and signature (ECDSA, P-256, SHA-256). Signed is all before the signature, followed by the
key expression, a zero byte, and the SHA-256 of the payload.
"""

import hashlib
import secrets
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime

import zenoh
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from armident.configs import ConfigError, DataError, SessionConfig
from armident.daq.identity.certificates import (
    ANY_CELL,
    REVOKED,
    Identity,
    Role,
    check_dates,
    identity_of,
    trusted_certificate,
    verify,
)
from armident.daq.identity.folder import KeyFolder, key_folder
from armident.daq.identity.permissions import Action, may

VERSION = 1
LARGEST = 4096
"""Largest attachment that is read, bytes; usual are 600."""
NONCE_BYTES = 16
_MOST_CERTIFICATES = 256
_MAGIC = b"ARMS"
_HEAD = struct.Struct("<4sBqBH")


@dataclass(frozen=True)
class Signed:
    """Signer of a message that was found right, time of its signature, ns UTC, and its nonce."""

    role: Role
    cell: str
    name: str
    time_ns: int
    nonce: bytes


class Signer:
    """Signs messages as a role in a cell; a renewed certificate is used without a restart."""

    def __init__(self, folder: KeyFolder, role: Role, cell: str, clock: Callable[[], int] = time.time_ns) -> None:
        self._folder, self._role, self._cell, self._clock = folder, role, cell, clock
        self._load()

    @property
    def identity(self) -> Identity:
        """Identity that signs."""
        if self._folder.stamp(f"{self._identity.name}.pem") != self._stamp:
            # While a renewal is under way, the present certificate is used.
            with suppress(ConfigError):
                self._load()
        return self._identity

    @property
    def is_valid(self) -> bool:
        """True if its certificate is valid now; what another one signs is refused everywhere."""
        certificate = self.identity.certificate
        at = datetime.fromtimestamp(self._clock() / 1e9, UTC)
        return certificate.not_valid_before_utc <= at <= certificate.not_valid_after_utc

    def attachment(self, key: str, payload: bytes, nonce: bytes = b"") -> bytes:
        """Return the attachment that signs a payload on a key expression."""
        identity = self.identity
        certificate = identity.certificate.public_bytes(Encoding.DER)
        signed = _HEAD.pack(_MAGIC, VERSION, self._clock(), len(nonce), len(certificate)) + nonce + certificate
        return signed + identity.sign(_covered(signed, key, payload))

    def reply(self, query: zenoh.Query, key: str, payload: bytes) -> None:
        """Answer a query, and sign its attachment with the answer if it is a nonce."""
        asked = query.attachment
        nonce = bytes(asked) if asked is not None and len(asked) == NONCE_BYTES else b""
        query.reply(key, payload, attachment=self.attachment(key, payload, nonce))

    def _load(self) -> None:
        self._identity = self._folder.identity(self._role, self._cell)
        self._stamp = self._folder.stamp(f"{self._identity.name}.pem")


class Trust:
    """Checks messages of one robot, below ``base`` (``armident/CELL/ROBOT``), against the authority of the plant."""

    def __init__(self, folder: KeyFolder, base: str, clock: Callable[[], int] = time.time_ns) -> None:
        self._folder, self._base, self._clock = folder, f"{base}/", clock
        self._cell = base.split("/")[1]
        self._known: dict[bytes, x509.Certificate] = {}
        self._load()

    def check(
        self,
        action: Action,
        key: zenoh.KeyExpr | str,
        payload: bytes,
        attachment: zenoh.ZBytes | bytes | None,
        *,
        nonce: bytes | None = None,
        after_ns: int | None = None,
    ) -> Signed:
        """Return the signer of a message who may do this with its key; DataError otherwise, with the reason.

        ``nonce``: that of the query which this answers. ``after_ns``: latest time of a message known so far, ns UTC.
        """
        try:
            if attachment is None:
                raise DataError("a message without signature, as of a former version; update its sender")
            if len(attachment) > LARGEST:
                raise DataError(f"an attachment of {len(attachment)} bytes")
            suffix = str(key).removeprefix(self._base)
            if suffix == str(key):
                raise DataError(f"not below {self._base}")
            time_ns, found, der, signed, signature = _parsed(bytes(attachment))
            certificate = self._certificate(der)
            role, cell, name = identity_of(certificate)
            if cell not in (self._cell, ANY_CELL):
                raise DataError(f"signed by {name} of cell {cell}")
            if not may(role, action, suffix):
                raise DataError(f"signed by {name}: the role {role} may not {action} it")
            verify(certificate, signature, _covered(signed, str(key), payload))
            if nonce is not None and found != nonce:
                raise DataError(f"an answer of {name} to another query")
            if after_ns is not None and time_ns <= after_ns:
                raise DataError(f"an old message of {name}, repeated")
        except DataError as error:
            raise DataError(f"{key}: {error}") from error
        return Signed(role, cell, name, time_ns, found)

    def _certificate(self, data: bytes) -> x509.Certificate:
        """Return a certificate that is valid now; its chain is checked once."""
        at = datetime.fromtimestamp(self._clock() / 1e9, UTC)
        if self._folder.stamp("authority.pem", REVOKED) != self._stamp:
            # While the file is replaced, the known authorities count.
            with suppress(ConfigError):
                self._load()
        certificate = self._known.get(data)
        if certificate is None:
            certificate = trusted_certificate(data, self._authorities, at, self._revoked)
            if len(self._known) >= _MOST_CERTIFICATES:
                self._known.clear()
            self._known[data] = certificate
        check_dates(certificate, at, identity_of(certificate)[2])
        return certificate

    def _load(self) -> None:
        # Before it is read: what is replaced meanwhile is read again.
        self._stamp = self._folder.stamp("authority.pem", REVOKED)
        self._authorities, self._revoked = self._folder.authority_certificates(), self._folder.revoked()
        self._known.clear()


def signer_for(session: SessionConfig, role: Role) -> Signer:
    """Return the signer of a role in the cell of a session; ConfigError if there is no key."""
    return Signer(key_folder(session.zenoh.keys), role, session.cell)


def trust_for(session: SessionConfig, base: str) -> Trust:
    """Return the check of messages below ``base`` for a session; ConfigError if there is no authority."""
    return Trust(key_folder(session.zenoh.keys), base)


def new_nonce() -> bytes:
    """Return a nonce for a query."""
    return secrets.token_bytes(NONCE_BYTES)


def _parsed(data: bytes) -> tuple[int, bytes, bytes, bytes, bytes]:
    """Return time, nonce, certificate, the bytes before the signature, and the signature of an attachment."""
    if len(data) < _HEAD.size or not data.startswith(_MAGIC):
        raise DataError("the attachment is no signature")
    _, version, time_ns, of_nonce, of_certificate = _HEAD.unpack_from(data)
    if version != VERSION:
        raise DataError(f"a signature of version {version}, this program reads {VERSION}")
    begin = _HEAD.size + of_nonce
    end = begin + of_certificate
    if end >= len(data):
        raise DataError("a signature shorter than its head states")
    return time_ns, data[_HEAD.size : begin], data[begin:end], data[:end], data[end:]


def _covered(signed: bytes, key: str, payload: bytes) -> bytes:
    return b"".join((signed, key.encode(), b"\0", hashlib.sha256(payload).digest()))
