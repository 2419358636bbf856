"""The command ``armident page``: addresses, sign-in by certificates of the plant, errors of one line, and its end."""

import http.client
import re
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

from armident.configs import ConfigError
from armident.daq.cli import application
from armident.daq.identity.certificates import (
    ANY_CELL,
    Authority,
    Role,
    new_authority,
    pem_of,
    read_certificates,
    write_identity,
    write_whole,
)
from armident.identify.page.addresses import address_of, is_loopback
from tests.fixtures import plant

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Sessions of two cells, without results."""
    for cell in ("press_2", "press_4"):
        plant.session(tmp_path, cell)
    return tmp_path


def keys(folder: Path, name: str, *people: str, addresses: tuple[str, ...] = ("127.0.0.1", "page.plant")) -> Authority:
    """Make a folder of keys of a plant, with the page's and people's."""
    (folder / name).mkdir()
    authority = new_authority(name, 30)
    write_whole(folder / name / "authority.pem", pem_of(authority.certificate), 0o644)
    write_identity(folder / name, authority.issue("viewer", ANY_CELL, "viewer.page", addresses, 30))
    (folder / f"{name}_people").mkdir()
    for person in people:
        write_identity(folder / f"{name}_people", authority.issue("viewer", ANY_CELL, f"viewer.{person}", (), 30))
    return authority


@contextmanager
def running(*words: str) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Run the command; yield the address that it prints."""
    command = [sys.executable, "-m", "armident.daq.cli", "page", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.fullmatch(r"page: (\S+) \(2 cells\)\n", line)
            assert found, f"{line}{process.stderr.read() if process.stderr else ''}"
            yield found[1], process
        finally:
            process.kill()


def test_a_signal_ends_the_page_in_order(folder: Path) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        with running("--config", str(folder), "--listen", "127.0.0.1:0") as (url, process):
            assert b"press_4" in fetch(url.removeprefix("http://").rstrip("/"))
            process.send_signal(number)
            _, stderr = process.communicate(timeout=60)
            assert (process.returncode, stderr) == (0, "")


def fetch(host: str) -> bytes:
    """Overview of a page without TLS."""
    connection = http.client.HTTPConnection(host, timeout=30)
    connection.request("GET", "/")
    return connection.getresponse().read()


def refused(*words: str) -> str:
    """Run the command, which ends with exit code 2; return its only line."""
    arguments = ["page", *words]
    result = CliRunner().invoke(application(arguments), arguments)
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    return line


def test_mistakes_are_one_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = ("--config", str(folder))
    assert "no such file" in refused("--config", str(folder / "none.yaml"))
    (tmp_path / "empty").mkdir()
    assert "no session of a cell there" in refused("--config", str(tmp_path / "empty"))
    assert "expected HOST:PORT" in refused(*config, "--listen", "8484")
    (tmp_path / "other").mkdir()
    plant.session(tmp_path / "other", "press_2")
    assert "another session is called press_2" in refused(*config, "--config", str(tmp_path / "other"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "already in use" in refused(*config, "--listen", f"127.0.0.1:{taken.getsockname()[1]}")
    monkeypatch.delenv("ARMIDENT_KEYS", raising=False)
    assert "no such folder of keys" in refused(*config, "--listen", "0.0.0.0:0", "--keys", str(tmp_path / "none"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert "keys of a plant; run: armident keys init" in refused(*config, "--listen", "0.0.0.0:0")
    keys(tmp_path, "bare", addresses=())
    assert "has no address" in refused(*config, "--listen", "0.0.0.0:0", "--keys", str(tmp_path / "bare"))


@pytest.mark.parametrize("listen", ["8484", ":8484", "127.0.0.1:", "127.0.0.1:99999", "::1:8484", "host:x"])
def test_a_wrong_address_is_refused(listen: str) -> None:
    with pytest.raises(ConfigError, match="expected HOST:PORT"):
        address_of(listen)


@pytest.mark.parametrize(
    ("listen", "loopback"),
    [
        ("localhost:1", True), ("127.0.0.1:1", True), ("127.9.9.9:1", True), ("[::1]:1", True),
        ("0.0.0.0:1", False), ("[::]:1", False), ("192.0.2.7:1", False), ("plant.example:1", False),
        ("localhost.example:1", False),
    ],
)  # fmt: skip
def test_only_loopback_needs_no_keys(listen: str, loopback: bool) -> None:
    host, port = address_of(listen)
    assert port == 1
    assert is_loopback(host) == loopback


def test_other_machines_sign_in_with_a_certificate_of_the_plant(folder: Path, tmp_path: Path) -> None:
    authority = keys(tmp_path, "plant", "anna", "otto")
    keys(tmp_path, "foreign", "eve")
    address = ("--listen", "0.0.0.0:0", "--keys", str(tmp_path / "plant"))
    with running("--config", str(folder), *address) as (url, _):
        port = int(url.rstrip("/").rpartition(":")[2])

        def asked(person: Path | None, host: str = "page.plant") -> int:
            context = ssl.create_default_context(cafile=str(tmp_path / "plant" / "authority.pem"))
            if person is not None:
                context.load_cert_chain(f"{person}.pem", f"{person}.key")
            connection = http.client.HTTPSConnection("127.0.0.1", port, context=context, timeout=30)
            connection.request("GET", "/", headers={"Host": host})
            return connection.getresponse().status

        anna, eve = (
            tmp_path / f"{name}_people" / f"viewer.{person}" for name, person in (("plant", "anna"), ("foreign", "eve"))
        )
        assert asked(anna) == 200
        assert asked(anna, f"127.0.0.1:{port}") == 200
        assert asked(anna, "evil.example") == 400
        for person in (None, eve):
            with pytest.raises((ssl.SSLError, ConnectionError, http.client.RemoteDisconnected)):
                asked(person)
        with pytest.raises((ConnectionError, http.client.HTTPException)):
            fetch(f"127.0.0.1:{port}")
        assert asked(anna) == 200

        otto = tmp_path / "plant_people" / "viewer.otto"
        context = ssl.create_default_context(cafile=str(tmp_path / "plant" / "authority.pem"))
        context.load_cert_chain(f"{otto}.pem", f"{otto}.key")
        with closing(http.client.HTTPSConnection("127.0.0.1", port, context=context, timeout=30)) as kept:
            kept.request("GET", "/", headers={"Host": "page.plant"})
            assert b"press_4" in kept.getresponse().read()
            revoked = authority.revocation_list(read_certificates(tmp_path / "plant_people" / "viewer.otto.pem"))
            write_whole(tmp_path / "plant" / "authority.crl", revoked, 0o644)
            kept.request("GET", "/", headers={"Host": "page.plant"})
            answer = kept.getresponse()
            assert (answer.status, b"viewer.otto: the certificate was revoked" in answer.read()) == (403, True)
        assert [asked(otto), asked(anna)] == [403, 200]
        # The page shows all cells; another role reads none of them.
        others: tuple[tuple[Role, str], ...] = (("viewer", "press_2"), ("opcua", ANY_CELL), ("capture", "press_2"))
        for role, cell in others:
            write_identity(tmp_path, authority.issue(role, cell, f"{role}.x", (), 30))
            assert asked(tmp_path / f"{role}.x") == 403
