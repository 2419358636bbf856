"""Certificates, and the folder in which they are found or made."""

import subprocess
import sys
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID

from armident.configs import ConfigError, DataError
from armident.daq.identity import VARIABLE
from armident.daq.identity import folder as folders
from armident.daq.identity.certificates import (
    Authority,
    Identity,
    Role,
    identity_of,
    new_authority,
    pem_of,
    read_identity,
    trusted_certificate,
    verify,
    write_identity,
    write_key,
    write_whole,
)
from armident.daq.identity.folder import KeyFolder, key_folder


def now() -> datetime:
    """Return the time of a call: certificates that are made later than the module was read are not valid then."""
    return datetime.now(UTC)


@pytest.fixture(scope="module")
def authority() -> Authority:
    return new_authority("plant", 365)


def der(identity: Identity) -> bytes:
    return identity.certificate.public_bytes(Encoding.DER)


def signer_of(certificate: bytes, authorities: Iterable[x509.Certificate], at: datetime) -> tuple[Role, str, str]:
    """Return role, cell and name of a certificate that is trusted."""
    return identity_of(trusted_certificate(certificate, authorities, at))


def test_a_certificate_has_role_cell_name_and_addresses(authority: Authority) -> None:
    identity = authority.issue("capture", "cell_1", "capture.cell_1", ["robot.plant.example", "192.0.2.7"], 30)
    assert signer_of(der(identity), [authority.certificate], now()) == ("capture", "cell_1", "capture.cell_1")
    names = identity.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["robot.plant.example"]
    assert names.get_values_for_type(x509.IPAddress) == [ip_address("192.0.2.7")]


def test_an_application_of_opc_ua_has_an_rsa_key_its_uri_and_the_usage_of_the_standard(authority: Authority) -> None:
    """OPC 10000-6, 6.2.2; the key is as strong as the curve P-256 (NIST SP 800-57, table 2)."""
    identity = authority.issue("opcua", "*", "opcua.scada", ["192.0.2.7"], 30)
    key, extensions = identity.certificate.public_key(), identity.certificate.extensions
    assert isinstance(key, rsa.RSAPublicKey)
    assert key.key_size == 3072
    names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.UniformResourceIdentifier) == ["urn:armident:opcua.scada"]
    usage = extensions.get_extension_for_class(x509.KeyUsage).value
    uses = (usage.digital_signature, usage.content_commitment, usage.key_encipherment, usage.data_encipherment)
    assert uses == (True, True, True, True)
    assert signer_of(der(identity), [authority.certificate], now())[0] == "opcua"
    # It signs no message and no document.
    with pytest.raises(DataError, match="does not fit"):
        verify(identity.certificate, b"x", b"y")


def test_a_role_has_its_kind_of_key(authority: Authority) -> None:
    """A certificate of RSA that claims another role is refused, whoever has signed it."""
    identity = authority.issue("opcua", "*", "opcua.scada", [], 30)
    subject = x509.Name([*identity.certificate.subject][:1])
    for oid, value in ((NameOID.ORGANIZATIONAL_UNIT_NAME, "capture"), (NameOID.ORGANIZATION_NAME, "c")):
        subject = x509.Name([*subject, x509.NameAttribute(oid, value)])
    forged = (
        x509.CertificateBuilder(authority.certificate.subject, subject, identity.certificate.public_key(), 7)
        .not_valid_before(now() - timedelta(days=1))
        .not_valid_after(now() + timedelta(days=1))
        .sign(authority.key, SHA256())
    )
    with pytest.raises(DataError, match="another kind of key than its role"):
        signer_of(forged.public_bytes(Encoding.DER), [authority.certificate], now())


@pytest.mark.parametrize(("role", "cell", "name"), [("worker", "c", "worker.c"), ("opcua", "*", "opcua.c")])
def test_openssl_verifies_the_chain(authority: Authority, tmp_path: Path, role: Role, cell: str, name: str) -> None:
    write_whole(tmp_path / "authority.pem", pem_of(authority.certificate), 0o644)
    write_identity(tmp_path, authority.issue(role, cell, name, ["localhost"], 30))
    for purpose in ("sslclient", "sslserver"):
        command = ["openssl", "verify", "-x509_strict", "-purpose", purpose, "-CAfile", "authority.pem", f"{name}.pem"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("days", "reason"), [(timedelta(days=31), "expired on"), (timedelta(minutes=-6), "valid from")]
)
def test_a_certificate_out_of_its_time_is_refused(authority: Authority, days: timedelta, reason: str) -> None:
    identity = authority.issue("viewer", "*", "viewer.ann", [], 30, now())
    with pytest.raises(DataError, match=reason):
        signer_of(der(identity), [authority.certificate], now() + days)


def test_another_authority_of_the_same_name_is_refused(authority: Authority) -> None:
    foreign = new_authority("plant", 365).issue("operator", "*", "operator.eve", [], 30)
    with pytest.raises(DataError, match="another authority"):
        signer_of(der(foreign), [authority.certificate], now())


def test_an_identity_issues_nothing(authority: Authority) -> None:
    capture = authority.issue("capture", "c", "capture.c", [], 30)
    assert isinstance(capture.key, ec.EllipticCurvePrivateKey)
    forged = Authority(capture.key, capture.certificate).issue("operator", "*", "operator.eve", [], 30)
    with pytest.raises(DataError, match="another authority"):
        signer_of(der(forged), [authority.certificate], now())
    with pytest.raises(DataError, match="without role"):
        signer_of(authority.certificate.public_bytes(Encoding.DER), [authority.certificate], now())


def test_both_authorities_are_trusted_during_renewal(authority: Authority) -> None:
    new = new_authority("plant", 365)
    both = [new.certificate, authority.certificate]
    for each in (authority, new):
        assert signer_of(der(each.issue("worker", "c", "worker.c", [], 9)), both, now())[0] == "worker"


@pytest.mark.parametrize(
    ("role", "cell", "name"), [("capture", "*", "x"), ("master", "c", "x"), ("viewer", "*", 65 * "x")]
)
def test_an_invalid_certificate_is_not_issued(authority: Authority, role: Role, cell: str, name: str) -> None:
    with pytest.raises(ConfigError):
        authority.issue(role, cell, name, [], 30)


def test_a_key_is_private(authority: Authority, tmp_path: Path) -> None:
    identity = authority.issue("worker", "c", "worker.c", [], 30)
    write_identity(tmp_path, identity)
    key = tmp_path / "worker.c.key"
    assert key.stat().st_mode & 0o777 == 0o600
    assert read_identity(tmp_path / "worker.c.pem").cell == "c"
    key.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod"):
        read_identity(tmp_path / "worker.c.pem")


def test_a_key_of_another_certificate_is_refused(authority: Authority, tmp_path: Path) -> None:
    one, two = (authority.issue("worker", "c", "worker.c", [], 30) for _ in range(2))
    write_identity(tmp_path, one)
    write_key(tmp_path / "worker.c.key", two.key)
    with pytest.raises(ConfigError, match="does not belong"):
        read_identity(tmp_path / "worker.c.pem")


@pytest.fixture
def no_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(folders, "OF_PLANT", tmp_path / "plant")
    monkeypatch.setattr(folders, "OF_SERVICES", tmp_path / "services")
    return tmp_path


def test_the_folder_of_the_plant_comes_before_the_local_one(no_folders: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert key_folder() == KeyFolder(no_folders / "state" / "armident" / "keys", local=True)
    (no_folders / "services").mkdir()
    assert key_folder() == KeyFolder(no_folders / "services", local=True)
    (no_folders / "plant").mkdir()
    assert key_folder() == KeyFolder(no_folders / "plant")
    (no_folders / "named").mkdir()
    monkeypatch.setenv(VARIABLE, str(no_folders / "named"))
    assert key_folder() == KeyFolder(no_folders / "named")
    assert key_folder(no_folders) == KeyFolder(no_folders)
    with pytest.raises(ConfigError, match="keys init"):
        key_folder(no_folders / "missing")


def test_a_folder_of_a_plant_makes_no_keys(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="armident keys enrol worker --cell c"):
        KeyFolder(tmp_path).identity("worker", "c")
    with pytest.raises(ConfigError, match="keys init"):
        KeyFolder(tmp_path).authority_certificates()
    assert not list(tmp_path.iterdir())


def test_two_processes_make_one_authority(no_folders: Path) -> None:
    program = (
        "from armident.daq.identity.folder import key_folder\n"
        "print(key_folder().identity('worker', 'c').certificate.serial_number)"
    )
    started = [subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) for _ in range(3)]
    assert len({process.communicate()[0] for process in started}) == 1
    folder = key_folder()
    assert signer_of(der(folder.identity("worker", "c")), folder.authority_certificates(), now())[1] == "c"
    assert (folder.path.stat().st_mode & 0o777, (folder.path / "authority.key").stat().st_mode & 0o777) == (
        0o700,
        0o600,
    )


def test_the_key_of_the_cell_comes_before_that_of_the_plant(authority: Authority, tmp_path: Path) -> None:
    folder = KeyFolder(tmp_path)
    for cell, name in (("*", "operator.ann"), ("c", "operator.ben"), ("d", "operator.cem")):
        write_identity(tmp_path, authority.issue("operator", cell, name, [], 30))
    assert folder.identity("operator", "c").name == "operator.ben"
    assert folder.identity("operator", "e").name == "operator.ann"
    with pytest.raises(ConfigError, match="enrol"):
        folder.identity("viewer", "c")


def test_a_renewed_identity_is_the_one_that_ends_last(authority: Authority, tmp_path: Path) -> None:
    for days in (30, 365):
        write_identity(tmp_path, authority.issue("worker", "c", f"worker.c{days}", [], days))
    assert KeyFolder(tmp_path).identity("worker", "c").name == "worker.c365"


def test_bytes_that_are_no_certificate_are_refused(authority: Authority) -> None:
    right = der(authority.issue("worker", "c", "worker.c", [], 9))
    for wrong in (b"", right[:-1], right.replace(b"\xa0\x03\x02\x01\x02", b"\xa0\x03\x02\x01\x33")):
        with pytest.raises(DataError, match="not a certificate"):
            signer_of(wrong, [authority.certificate], now())


def test_a_name_of_a_stranger_does_not_break_the_line_of_the_log(authority: Authority) -> None:
    foreign = new_authority("plant", 365).issue("worker", "c", "worker\nERROR", [], 9)
    with pytest.raises(DataError) as caught:
        signer_of(der(foreign), [authority.certificate], now())
    assert "\n" not in str(caught.value)
