"""Authority of a plant: enrols roles, renews and revokes their certificates, and checks a folder of keys."""

import logging
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID

from armident.configs import ConfigError, DataError, SessionConfig
from armident.configs.reasons import reason_of
from armident.daq.identity.access import ROUTER_FILE, explained, host_of, is_loopback, router_file, router_name
from armident.daq.identity.certificates import (
    ANY_CELL,
    REVOKED,
    ROLES,
    Authority,
    Identity,
    Role,
    identity_of,
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
from armident.daq.identity.folder import KeyFolder, key_folder

log = logging.getLogger(__name__)

AUTHORITY = "authority"
"""Name of the authority among those of its folder."""
AUTHORITY_DAYS = 3650
"""Validity of an authority, days."""
WARN_DAYS, FAIL_DAYS = 30, 7
"""Days before the end of a certificate from which it is a warning, and a failure."""

Verdict = Literal["ok", "warning", "failed"]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,49}")
_CELL = re.compile(r"[a-z][a-z0-9_]{0,63}")


@dataclass(frozen=True)
class Finding:
    """Result of one check of a folder of keys."""

    verdict: Verdict
    message: str


@dataclass(frozen=True)
class Enrolled:
    """Certificate of a role in a folder of keys."""

    role: Role
    cell: str
    name: str
    certificate: x509.Certificate

    @property
    def addresses(self) -> list[str]:
        """DNS names and IP addresses under which it is reached."""
        try:
            names = self.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except x509.ExtensionNotFound:
            return []
        return [str(name.value) for name in names]

    def row(self, now: datetime) -> dict[str, Any]:
        """Return what is shown of it, by column."""
        return {
            "name": self.name, "role": self.role, "cell": self.cell,
            "valid_until": f"{self.certificate.not_valid_after_utc:%Y-%m-%d}",
            "days_left": days_left(self.certificate, now), "addresses": self.addresses,
        }  # fmt: skip


def days_left(certificate: x509.Certificate, now: datetime) -> int:
    """Return the whole days until a certificate ends; negative if it has ended."""
    return (certificate.not_valid_after_utc - now) // timedelta(days=1)


def make_authority(folder: Path, plant: str) -> None:
    """Make the authority of a plant in a folder; ConfigError if there is one already."""
    _check_name(plant, "--plant")
    for file in (folder / "authority.pem", folder / "authority.key"):
        if file.exists():
            raise ConfigError(f"{file}: exists already; choose another --folder, or: armident keys renew {AUTHORITY}")
    try:
        folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: no keys can be made: {reason_of(error, named=False, step=True)}") from error
    authority = new_authority(plant, AUTHORITY_DAYS)
    write_key(folder / "authority.key", authority.key)
    write_whole(folder / "authority.pem", pem_of(authority.certificate), 0o644)


def plant_of(folder: Path) -> str:
    """Return the name of the plant whose authority is trusted in a folder."""
    found = read_certificates(folder / "authority.pem")[0].subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else ""


def enrolled(folder: Path) -> list[Enrolled]:
    """Return the certificates of roles in a folder, by name; ConfigError names a file that is none."""
    return [_read(path) for path in _files(folder)]


def enrol(folder: Path, role: str, cell: str | None, name: str | None, addresses: Sequence[str], days: int) -> Identity:
    """Make the certificate and key of a role, and the configuration of the router anew; ConfigError says what is wrong.

    ``cell``: needed of a capture and a worker; without, an operator or viewer is one of all cells. ``name``: second
    part of the name in the certificate; by default the cell, and of a router the plant.
    """
    known = next((each for each in ROLES if each == role), None)
    if known is None:
        raise ConfigError(f"no role {role!r}; expected {', '.join(ROLES)}")
    if known == "router":
        if cell is not None or name is not None:
            raise ConfigError("a router has neither --cell nor --name: all routers of a plant have one certificate")
        if not addresses:
            raise ConfigError("a router needs --address, once for each DNS name or IP address to reach it")
        full = router_name(plant_of(folder))
    elif known == "opcua" and cell is not None:
        raise ConfigError("opcua has no --cell: its server has all cells; give --name")
    else:
        if cell is not None and not _CELL.fullmatch(cell):
            raise ConfigError(f"--cell {cell!r}: expected the name of a cell as in its session, such as press_7")
        if name is None and cell is None:
            raise ConfigError(f"{role}: --cell is missing" + ("" if known in ("capture", "worker") else ", or --name"))
        full = f"{role}.{_check_name(name or str(cell), '--name')}"
    for file in (folder / f"{full}.pem", folder / f"{full}.key"):
        if file.exists():
            raise ConfigError(f"{file}: exists already; choose another --name, or: armident keys renew {full}")
    if _revoked(folder, full).exists():
        raise ConfigError(f"{full} was revoked; choose another --name, so that its old certificate stays worthless")
    return _issue(folder, known, cell or ANY_CELL, full, addresses, days)


def renew(folder: Path, name: str, addresses: Sequence[str], days: int) -> Identity:
    """Replace certificate and key of a name; role and cell stay, and the addresses unless others are given."""
    old = _known(folder, name)
    # A former certificate is valid until it ends: a revocation needs it.
    write_whole(folder / f"{name}.pem.former", pem_of(old.certificate, *_former(folder, name)), 0o644)
    return _issue(folder, old.role, old.cell, name, addresses or old.addresses, days)


def renew_authority(folder: Path) -> None:
    """Make a new key of the authority; the certificates of the former ones stay trusted until they end."""
    read_authority(folder)
    new = new_authority(plant_of(folder), AUTHORITY_DAYS)
    old = [each for each in read_certificates(folder / "authority.pem") if days_left(each, datetime.now(UTC)) >= 0]
    # In this order an interrupted renewal leaves the former key, which is still trusted.
    write_whole(folder / "authority.pem", pem_of(new.certificate, *old), 0o644)
    write_key(folder / "authority.key", new.key)
    _write_revoked(folder, new)


def revoke(folder: Path, name: str) -> None:
    """Remove a name from the access control, add its certificates to the revocation list, and never enrol it again."""
    authority, own = read_authority(folder), _known(folder, name)
    if own.role == "router":
        raise ConfigError(f"{name}: a router is not revoked: make a new authority (keys init), and enrol all names")
    write_whole(_revoked(folder, name), pem_of(own.certificate, *_former(folder, name)), 0o644)
    _write_revoked(folder, authority)
    for end in ("pem", "key", "pem.former"):
        (folder / f"{name}.{end}").unlink(missing_ok=True)
    write_router(folder)


def write_router(folder: Path) -> None:
    """Write the configuration of the router from the certificates in the folder of the authority."""
    write_whole(folder / ROUTER_FILE, _router_text(folder).encode(), 0o644)


def findings(folder: Path, now: datetime, session: SessionConfig | None = None) -> Iterator[Finding]:
    """Check everything in a folder of keys that would fail later; ``session``: only what its cell uses."""
    is_plant = (folder / "authority.key").exists()
    try:
        authorities = read_certificates(folder / "authority.pem")
        if is_plant:
            read_authority(folder)
    except ConfigError as error:
        yield Finding("failed", str(error))
        return
    yield _ending(AUTHORITY, authorities[0], now)
    for path in _files(folder):
        try:
            each = _read(path)
            if session is not None and each.cell != session.cell:
                continue
            if path.with_suffix(".key").exists() or not is_plant:  # There the key may have been handed over.
                read_identity(path)
            trusted_certificate(each.certificate.public_bytes(Encoding.DER), authorities, now)
        except (ConfigError, DataError) as error:
            yield Finding("failed", str(error))
        else:
            yield _ending(each.name, each.certificate, now)
    if is_plant and session is None:
        yield _router(folder)


def of_session(session: SessionConfig, now: datetime) -> Iterator[Finding]:
    """Check the keys of the plant that a session uses; those of this machine alone need no check."""
    try:
        folder = key_folder(session.zenoh.keys)
    except ConfigError as error:
        yield Finding("failed", str(error))
    else:
        if not folder.local:
            yield from findings(folder.path, now, session)


def certificate_ends(session: SessionConfig, role: Role) -> dict[tuple[str, ...], float]:
    """Return the ends of the authority and of the certificate of a role in a cell, by name, s UTC; empty without."""
    with suppress(ConfigError):
        folder = key_folder(session.zenoh.keys)
        return _ends(folder, role, session.cell, folder.stamp(f"{AUTHORITY}.pem"))
    return {}


@lru_cache(maxsize=8)
def _ends(folder: KeyFolder, role: Role, cell: str, _stamp: tuple[int, ...]) -> dict[tuple[str, ...], float]:
    own, authority = folder.identity(role, cell), folder.authority_certificates()[0]
    return {
        (name,): each.not_valid_after_utc.timestamp()
        for name, each in ((own.name, own.certificate), (AUTHORITY, authority))
    }


class Countdown:
    """Logs once a day which certificates of a session end soon or fail."""

    def __init__(self, session: SessionConfig) -> None:
        self._session, self._due = session, time.monotonic()

    def check(self) -> None:
        """Log what is found if a day has passed since the last time."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + 86_400
            for each in of_session(self._session, datetime.now(UTC)):
                if each.verdict != "ok":
                    log.log(logging.ERROR if each.verdict == "failed" else logging.WARNING, "keys: %s", each.message)


def missing(folder: Path, session: SessionConfig) -> Iterator[Finding]:
    """Check that a folder has what the endpoints of a session need: roles, and addresses in their certificates."""
    of_cell = [each for each in enrolled(folder) if each.cell == session.cell]
    for role in ("capture", "worker"):
        own = [each for each in of_cell if each.role == role]
        if not own:
            command = f"armident keys enrol {role} --cell {session.cell}"
            reason = f"{folder}: no certificate of a {role} of cell {session.cell}, which it needs to run here"
            yield Finding("warning" if of_cell else "failed", f"{reason}; run: {command}")
        for host in (host_of(place) for place in session.zenoh.listen if not is_loopback(place)):
            for each in own:
                if host not in (*each.addresses, "0.0.0.0", "::"):
                    command = f"armident keys renew {each.name} --address {host}"
                    yield Finding("failed", f"{each.name}: its certificate is not for {host}; run: {command}")


def _router(folder: Path) -> Finding:
    """Check that the configuration of the router is that of the enrolled names."""
    path = folder / ROUTER_FILE
    try:
        if path.read_text() == _router_text(folder):
            return Finding("ok", f"{path}: access control of all enrolled names")
        reason = "does not match the enrolled names"
    except FileNotFoundError:
        reason = "is missing"
    except (OSError, ConfigError) as error:
        return Finding("failed", str(error))
    return Finding("failed", f"{path}: {reason}; run: armident keys router, and copy it to the host of the router")


def explanations(folder: Path) -> list[str]:
    """Return what each enrolled name may do, in words; nothing if a file in the folder is none of these."""
    try:
        return [explained(each.role, each.cell, each.name) for each in enrolled(folder)]
    except ConfigError:
        return []


def _ending(name: str, certificate: x509.Certificate, now: datetime) -> Finding:
    """Check the time until a certificate ends."""
    days = days_left(certificate, now)
    end = f"{name}: {'expired on' if days < 0 else 'valid until'} {certificate.not_valid_after_utc:%Y-%m-%d}"
    if days >= WARN_DAYS:
        return Finding("ok", f"{end}, {days} days")
    left = "" if days < 0 else f", in {days} days"
    verdict: Verdict = "warning" if days >= FAIL_DAYS else "failed"
    return Finding(verdict, f"{end}{left}; run where the authority is: armident keys renew {name}")


def _issue(folder: Path, role: Role, cell: str, name: str, addresses: Sequence[str], days: int) -> Identity:
    authority = read_authority(folder)
    # A certificate that outlives its authority would be refused without a warning of its own.
    days = min(days, days_left(authority.certificate, datetime.now(UTC)))
    if days < 1:
        raise ConfigError(f"the authority in {folder} has expired; run: armident keys renew {AUTHORITY}")
    identity = authority.issue(role, cell, name, addresses, days)
    write_identity(folder, identity)
    _write_revoked(folder, authority)
    write_router(folder)
    return identity


def _files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("*.pem")) if path.stem != AUTHORITY]


def _read(path: Path) -> Enrolled:
    certificate = read_certificates(path)[0]
    try:
        each = Enrolled(*identity_of(certificate), certificate)
    except DataError as error:
        raise ConfigError(f"{path}: {error}") from error
    if each.name != path.stem:
        raise ConfigError(f"{path}: is the certificate of {each.name}; expected the name {each.name}.pem")
    return each


def _known(folder: Path, name: str) -> Enrolled:
    for each in enrolled(folder):
        if each.name == name:
            return each
    raise ConfigError(f"{folder}: no {name}.pem; armident keys show lists all names")


def _router_text(folder: Path) -> str:
    return router_file(((each.role, each.cell, each.name) for each in enrolled(folder)), plant_of(folder))


def _revoked(folder: Path, name: str) -> Path:
    return folder / f"{name}.pem.revoked"


def _write_revoked(folder: Path, authority: Authority) -> None:
    revoked = [each for path in sorted(folder.glob("*.pem.revoked")) for each in read_certificates(path)]
    write_whole(folder / REVOKED, authority.revocation_list(revoked), 0o644)


def _former(folder: Path, name: str) -> tuple[x509.Certificate, ...]:
    path = folder / f"{name}.pem.former"
    return read_certificates(path) if path.exists() else ()


def _check_name(name: str, option: str) -> str:
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{option} {name!r}: expected letters, digits, '.', '-' and '_', at most 50, such as anna")
    return name
