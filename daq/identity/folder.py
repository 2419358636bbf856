"""Folder of keys: that of the plant, or one of this user, in which keys for loopback are made when needed."""

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from armident.configs import ConfigError
from armident.configs.reasons import reason_of
from armident.configs.yaml_loader import is_file
from armident.daq.identity import OF_PLANT, VARIABLE
from armident.daq.identity.certificates import (
    ANY_CELL,
    REVOKED,
    Identity,
    Role,
    new_authority,
    pem_of,
    read_authority,
    read_certificates,
    read_identity,
    trusted_certificate,
    write_identity,
    write_key,
    write_whole,
)

OF_SERVICES = Path("/var/lib/armident/keys")
"""Local folder that the services of a machine share."""
_FROM, _DAYS = datetime(1970, 1, 2, tzinfo=UTC), 47_481
"""Begin and duration, to the end of 2099, of local certificates: a machine without a set clock needs them, too."""


@dataclass(frozen=True)
class KeyFolder:
    """Folder with ``authority.pem``, perhaps ``authority.key``, and ``NAME.pem`` and ``NAME.key`` of identities.

    ``local``: authority and identities are made here when they are first needed.
    """

    path: Path
    local: bool = False

    def identity(self, role: Role, cell: str) -> Identity:
        """Return the identity of a role for a cell, or of any (`ANY_CELL`); ConfigError if the plant has none here."""
        found = self._find(role, cell)
        if found is None and self.local:
            with self._locked():
                # Another process may have made it while this one waited.
                found = self._find(role, cell)
                if found is None:
                    of, name = (ANY_CELL, "local") if role in ("operator", "viewer") else (cell, cell)
                    issue, addresses = read_authority(self.path).issue, ("localhost", "127.0.0.1", "::1")
                    found = issue(role, of, f"{role}.{name}"[:64], addresses, _DAYS, _FROM)
                    write_identity(self.path, found)
        if found is None:
            where, option = f"cell {cell}", f"--cell {cell}"
            if cell == ANY_CELL:
                where, option = "all cells", "--name NAME --address HOST"
            raise ConfigError(
                f"{self.path}: no key of a {role} of {where}; "
                f"run where the authority is: armident keys enrol {role} {option}"
            )
        return found

    def authority_certificates(self) -> tuple[x509.Certificate, ...]:
        """Return the certificates of the trusted authorities; ConfigError if there is none."""
        path = self.path / "authority.pem"
        if self.local and not is_file(path):
            with self._locked():
                pass
        if not is_file(path):
            raise ConfigError(f"{path}: no such file; copy it from the machine on which armident keys init ran")
        return read_certificates(path)

    def revoked(self) -> frozenset[int]:
        """Return the serial numbers in the revocation list, if there is one; ConfigError if it is none of the plant."""
        try:
            data = (self.path / REVOKED).read_bytes()
        except FileNotFoundError:
            return frozenset()
        except OSError as error:
            raise ConfigError(reason_of(error)) from error
        keys = (each.public_key() for each in self.authority_certificates())
        with suppress(ValueError):
            found = x509.load_pem_x509_crl(data)
            if any(found.is_signature_valid(key) for key in keys if isinstance(key, ec.EllipticCurvePublicKey)):
                return frozenset(each.serial_number for each in found)
        raise ConfigError(f"{self.path / REVOKED}: not the revocation list of the authority; copy it again")

    def trusted(self, certificate_der: bytes, at: datetime) -> x509.Certificate:
        """Return a certificate of the plant that is valid at a time and not revoked; DataError, ConfigError if none."""
        return trusted_certificate(certificate_der, self.authority_certificates(), at, self.revoked())

    def stamp(self, *names: str) -> tuple[int, ...]:
        """Return the times of change of the folder and of files in it, by which a renewal is noticed."""
        found = []
        for path in (self.path, *(self.path / name for name in names)):
            found.append(0)
            with suppress(OSError):
                found[-1] = path.stat().st_mtime_ns
        return tuple(found)

    def _find(self, role: Role, cell: str) -> Identity | None:
        """Return the identity whose certificate ends last, rather of the cell than of the plant."""
        found, refused = [], None
        for path in sorted(self.path.glob(f"{role}.*.pem")):
            try:
                identity = read_identity(path)
            except ConfigError as error:
                refused = error
                continue
            if identity.role == role and (cell == ANY_CELL or identity.cell in (cell, ANY_CELL)):
                found.append(identity)
        if not found and refused is not None:
            raise refused
        return max(found, key=lambda each: (each.cell == cell, each.certificate.not_valid_after_utc), default=None)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock of the folder; the folder and its authority are made if they are missing."""
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            reason = reason_of(error, named=False)
            raise ConfigError(f"{self.path}: no keys can be made: {reason}; set XDG_STATE_HOME") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not is_file(self.path / "authority.pem"):
                authority = new_authority(f"local {socket.gethostname()}"[:64], _DAYS, _FROM)
                write_key(self.path / "authority.key", authority.key)
                write_whole(self.path / "authority.pem", pem_of(authority.certificate), 0o644)
            yield
        finally:
            os.close(lock)


def key_folder(chosen: Path | None = None) -> KeyFolder:
    """Return the folder of keys: ``chosen`` (``zenoh.keys`` of a session), else the plant's, else a local one."""
    named = os.environ.get(VARIABLE)
    for path in (chosen, Path(named) if named else None):
        if path is not None:
            if not os.path.isdir(path):
                raise ConfigError(f"{path}: no such folder of keys; run: armident keys init")
            return KeyFolder(path)
    # A user who may not look into /etc/armident has keys of his own.
    if os.path.isdir(OF_PLANT):
        return KeyFolder(OF_PLANT)
    if os.access(OF_SERVICES, os.W_OK):
        return KeyFolder(OF_SERVICES, local=True)
    state = os.environ.get("XDG_STATE_HOME")
    with suppress(RuntimeError):
        return KeyFolder((Path(state) if state else Path.home() / ".local" / "state") / "armident" / "keys", local=True)
    raise ConfigError("no folder for keys: this user has no home; set XDG_STATE_HOME")
