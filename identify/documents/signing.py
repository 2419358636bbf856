"""Signatures of result documents: who wrote a document, as what and when, and that it was not changed."""

import base64
import getpass
import importlib.metadata
import json
import os
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from armident.configs import ArmidentError, ConfigError, DataError
from armident.identify.documents.files import read_json, to_json, write_atomically

if TYPE_CHECKING:
    from cryptography import x509

    from armident.daq.identity.certificates import Identity

_DOMAIN = b"armident/document/1\n"
"""Begin of what is signed, so that a signature of a document is none of a message."""


def write_document(path: Path, document: BaseModel, identity: "Identity | None" = None) -> None:
    """Write a document, signed by an identity, else by the operator who has a key of the plant, else unsigned."""
    content, signer = to_json(document), identity or _operator()
    write_atomically(path, content if signer is None else _signed(content, signer))


def sign_file(path: Path, identity: "Identity") -> str:
    """Sign the document in a file, and return its new text, also if the file cannot be written."""
    text = _signed(path.read_text(encoding="utf-8"), identity)
    with suppress(OSError):
        write_atomically(path, text)
    return text


def is_signed_in_time(text: bytes) -> bool:
    """Return False if the certificate that signed a document was not valid at that time: nobody accepts it."""
    from cryptography import x509

    content = json.loads(text)
    if "signature" not in content:
        return True
    certificate = x509.load_der_x509_certificate(base64.b64decode(content["signature"]["certificate"]))
    at = datetime.fromisoformat(content["provenance"]["time"])
    return certificate.not_valid_before_utc <= at <= certificate.not_valid_after_utc


def verify_command(files: Sequence[Path], keys: Path | None, *, as_json: bool) -> int:
    """Carry out ``armident verify``; 1 if a document is not rightly signed, otherwise 0."""
    from armident.daq.identity.folder import key_folder

    authorities, results = key_folder(keys).authority_certificates(), list[dict[str, Any]]()
    for path in files:
        try:
            found = {"file": str(path), "verified": True} | _verified(read_json(path), authorities)
            stated = "unchanged, signed by {name} ({role} of {cell}) on {host} at {time}".format_map(found)
        except DataError as error:
            found = {"file": str(path), "verified": False, "reason": str(error).removeprefix(f"{path}: ")}
            stated = f"NOT VERIFIED: {found['reason']}"
        results.append(found)
        if not as_json:
            print(f"{path}: {stated}")
    if as_json:
        print(json.dumps(results, indent=1))
    return 0 if all(found["verified"] for found in results) else ArmidentError.exit_code


def _verified(content: Mapping[str, Any], authorities: Sequence["x509.Certificate"]) -> dict[str, str]:
    """Return signer and provenance of a document; DataError if it is not signed, or not as it was signed."""
    from armident.daq.identity.certificates import identity_of, trusted_certificate, verify
    from armident.daq.identity.permissions import may

    signature, provenance = content.get("signature"), content.get("provenance", {})
    if signature is None:
        raise DataError("not signed: nobody says who wrote it, nor that it is unchanged")
    try:
        der, value = (base64.b64decode(signature[key], validate=True) for key in ("certificate", "value"))
        origin = {key: str(provenance[key]) for key in ("armident", "host", "user", "time")}
        certificate = trusted_certificate(der, authorities, datetime.fromisoformat(origin["time"]))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError("its signature or provenance is damaged") from error
    role, cell, name = identity_of(certificate)
    if not may(role, "sign", "documents"):
        raise DataError(f"signed by {name}: the role {role} may not sign documents")
    verify(certificate, value, _canonical(content))
    return {"name": name, "role": role, "cell": cell, **origin}


def _signed(text: str, identity: "Identity") -> str:
    from cryptography.hazmat.primitives.serialization import Encoding

    provenance = {
        "armident": importlib.metadata.version("armident"),
        "host": socket.gethostname(),
        "user": _user(),
        "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
    }
    content = json.loads(text) | {"provenance": provenance}
    parts = {
        "certificate": identity.certificate.public_bytes(Encoding.DER),
        "value": identity.sign(_canonical(content)),
    }
    signature = {key: base64.b64encode(part).decode() for key, part in parts.items()}
    return json.dumps(content | {"signature": signature}, indent=1, ensure_ascii=False) + "\n"


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def _canonical(content: Mapping[str, Any]) -> bytes:
    """Return what is signed: the document without its signature, keys sorted, without blanks, numbers as Python's."""
    unsigned = {key: value for key, value in content.items() if key != "signature"}
    return _DOMAIN + json.dumps(unsigned, sort_keys=True, separators=(",", ":")).encode()


def _operator() -> "Identity | None":
    """Return the identity of a person who has one in the folder of the plant; cryptography is loaded only then."""
    from armident.daq.identity import OF_PLANT, VARIABLE

    if not (os.environ.get(VARIABLE) or os.path.isdir(OF_PLANT)):
        return None
    from armident.daq.identity.certificates import ANY_CELL
    from armident.daq.identity.folder import key_folder

    try:
        return key_folder().identity("operator", ANY_CELL)
    except ConfigError:
        return None
