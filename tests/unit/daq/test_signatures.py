"""Signatures of messages while certificates are renewed, and the permissions of the roles."""

from pathlib import Path

import pytest

from armident.configs import DataError
from armident.daq.identity.certificates import ROLES, Role, new_authority, pem_of, write_identity, write_whole
from armident.daq.identity.folder import KeyFolder
from armident.daq.identity.permissions import PERMISSIONS, may
from armident.daq.identity.signatures import Signer, Trust

BASE = "armident/c/r"
KEY = f"{BASE}/events"


def test_renewed_certificates_and_authorities_are_used_without_a_restart(tmp_path: Path) -> None:
    first, second = new_authority("plant", 365), new_authority("plant", 730)
    write_whole(tmp_path / "authority.pem", pem_of(first.certificate), 0o644)
    write_identity(tmp_path, first.issue("capture", "c", "capture.c", [], 30))
    folder = KeyFolder(tmp_path)
    signer, trust = Signer(folder, "capture", "c"), Trust(folder, BASE)
    before = signer.attachment(KEY, b"x")
    assert trust.check("publish", KEY, b"x", before).name == "capture.c"
    write_whole(tmp_path / "authority.pem", pem_of(second.certificate, first.certificate), 0o644)
    write_identity(tmp_path, second.issue("capture", "c", "capture.c", [], 60))
    after = signer.attachment(KEY, b"x")
    assert signer.identity.certificate.issuer == second.certificate.subject
    for attachment in (before, after):
        assert trust.check("publish", KEY, b"x", attachment).name == "capture.c"
    write_whole(tmp_path / "authority.pem", pem_of(second.certificate), 0o644)
    assert trust.check("publish", KEY, b"x", after).name == "capture.c"
    with pytest.raises(DataError, match="another authority"):
        trust.check("publish", KEY, b"x", before)
    write_whole(tmp_path / "authority.crl", second.revocation_list([signer.identity.certificate]), 0o644)
    with pytest.raises(DataError, match=r"capture\.c: the certificate was revoked"):
        trust.check("publish", KEY, b"x", after)
    write_whole(tmp_path / "authority.crl", second.revocation_list([]), 0o644)
    assert trust.check("publish", KEY, b"x", after).name == "capture.c"
    # A renewal that is under way, or failed, stops nobody.
    (tmp_path / "capture.c.key").write_bytes(b"")
    (tmp_path / "authority.pem").unlink()
    assert trust.check("publish", KEY, b"x", signer.attachment(KEY, b"x")).name == "capture.c"


def test_a_message_is_bound_to_its_time_and_nonce(tmp_path: Path) -> None:
    folder = KeyFolder(tmp_path / "keys", local=True)
    trust = Trust(folder, BASE)
    attachment = Signer(folder, "capture", "c", lambda: 5).attachment(KEY, b"x", bytes(16))
    signed = trust.check("publish", KEY, b"x", attachment, nonce=bytes(16), after_ns=4)
    assert (signed.time_ns, signed.nonce) == (5, bytes(16))
    with pytest.raises(DataError, match="to another query"):
        trust.check("publish", KEY, b"x", attachment, nonce=b"\1" * 16)
    with pytest.raises(DataError, match="repeated"):
        trust.check("publish", KEY, b"x", attachment, after_ns=5)


def test_a_machine_whose_clock_is_not_set_can_sign_on_loopback(tmp_path: Path) -> None:
    folder = KeyFolder(tmp_path / "keys", local=True)
    attachment = Signer(folder, "capture", "c").attachment(KEY, b"x")
    assert Trust(folder, BASE, lambda: 2 * 86_400 * 10**9).check("publish", KEY, b"x", attachment)
    assert Trust(folder, BASE, lambda: 4_000_000_000 * 10**9).check("publish", KEY, b"x", attachment)


def test_a_viewer_changes_nothing_and_only_an_operator_commands() -> None:
    assert not PERMISSIONS["viewer"].publish + PERMISSIONS["viewer"].answer + PERMISSIONS["viewer"].sign
    commanding: list[Role] = [role for role in ROLES if may(role, "ask", "command/stop")]
    assert commanding == ["operator"]
    assert [role for role in ROLES if may(role, "publish", "samples")] == ["capture"]
    assert [role for role in ROLES if may(role, "publish", "result/identification")] == ["worker"]
    assert [role for role in ROLES if not may(role, "read", "samples")] == ["capture", "router", "opcua"]
