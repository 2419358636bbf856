"""The command ``armident opcua`` with a real client: nodes, refusals, keys, limits, and hostile clients.

Types and identifiers are those of OPC 40010-1 (NodeIds of its information model).
"""

import asyncio
import math
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties
from asyncua.ua.uaerrors import BadCertificateUntrusted, BadIdentityTokenRejected, BadUserAccessDenied
from cryptography.hazmat.primitives.serialization import Encoding
from typer.testing import CliRunner

from armident.daq.cli import application
from armident.daq.identity.certificates import (
    ANY_CELL,
    Authority,
    new_authority,
    pem_of,
    read_authority,
    read_certificates,
    write_identity,
    write_key,
    write_whole,
)
from armident.identify.opcua.clients import FASTEST_MS, NODES, SESSIONS, SLOWEST_MS, SUBSCRIPTIONS
from armident.identify.opcua.nodes import DI, OWN, ROBOTICS
from tests.fixtures import plant
from tests.unit.identify.opcua.conftest import LONGEST_S, Heard, asked, health, serving

pytestmark = pytest.mark.slow

ARM = "MotionDeviceSystem/MotionDevices/press_2"


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Session of a cell without results."""
    return plant.session(tmp_path_factory.mktemp("plant"), "press_2")


@pytest.fixture(scope="module")
def url(cell: Path) -> Iterator[str]:
    """Address of a server, for clients that change nothing."""
    with serving(cell) as (found, _):
        yield found


async def model(client: Client) -> str | None:
    """Model of the arm, as a client reads it."""
    place = ua.NodeId(f"{ARM}/Model", await client.get_namespace_index(OWN))
    text: str | None = (await client.get_node(place).read_value()).Text
    return text


def test_an_arm_has_the_types_of_the_standard(url: str) -> None:
    async def question(client: Client) -> None:
        di, robots, own = [await client.get_namespace_index(uri) for uri in (DI, ROBOTICS, OWN)]
        arm = client.get_node(ua.NodeId(ARM, own))
        assert await arm.read_type_definition() == ua.NodeId(1004, robots)
        assert (await (await arm.get_child(f"{di}:Model")).read_value()).Text == "emps"
        for name in ("Manufacturer", "SerialNumber"):
            found = await (await arm.get_child(f"{di}:{name}")).read_data_value(raise_on_bad_status=False)
            assert found.StatusCode is not None
            assert found.StatusCode.name == "BadNoData"
        axis = await arm.get_child([f"{robots}:Axes", f"{robots}:joint_1"])
        assert await axis.read_type_definition() == ua.NodeId(16601, robots)
        assert await (await axis.get_child(f"{robots}:MotionProfile")).read_value() == 3, "the EMPS is a linear axis"
        train = await arm.get_child([f"{robots}:PowerTrains", f"{robots}:PowerTrain_1"])
        assert await train.get_referenced_nodes(ua.NodeId(18178, robots), ua.BrowseDirection.Forward) == [axis]
        assert await axis.get_referenced_nodes(ua.NodeId(18179, robots), ua.BrowseDirection.Forward) == [train]
        assert await (await train.get_child(f"{robots}:Motor")).read_type_definition() == ua.NodeId(1019, robots)

    asked(url, question)


def test_a_coupled_transmission_moves_other_axes_than_it_requires(tmp_path: Path) -> None:
    """TX40: motor 6 turns with joint 5. Joint 5 alone needs both motors, and motor 5 alone moves both joints."""
    session = plant.session(tmp_path, "press_2")
    session.write_text(session.read_text().replace("emps.yaml", "tx40.yaml"))

    async def question(client: Client) -> tuple[list[str], list[str]]:
        robots, own = [await client.get_namespace_index(uri) for uri in (ROBOTICS, OWN)]
        axis = client.get_node(ua.NodeId(f"{ARM}/Axes/joint_5", own))
        train = client.get_node(ua.NodeId(f"{ARM}/PowerTrains/PowerTrain_5", own))
        needed = await axis.get_referenced_nodes(ua.NodeId(18179, robots), ua.BrowseDirection.Forward)
        moved = await train.get_referenced_nodes(ua.NodeId(18178, robots), ua.BrowseDirection.Forward)
        last = [[str(each.nodeid.Identifier).rpartition("/")[2] for each in nodes] for nodes in (needed, moved)]
        return last[0], last[1]

    with serving(session) as (url, _):
        assert asked(url, question) == (["PowerTrain_5", "PowerTrain_6"], ["joint_5", "joint_6"])


def test_without_results_no_reading_has_a_value(url: str) -> None:
    for name, reading in asked(url, lambda client: health(client, "press_2")).items():
        assert (reading.Value.Value, reading.StatusCode.name) == (None, "BadNoData"), name


def test_clients_change_nothing(url: str) -> None:
    async def question(client: Client) -> None:
        own = await client.get_namespace_index(OWN)
        # asyncua lets the second one, of the standard, be written.
        for node in (ua.NodeId(f"{ARM}/Axes/joint_1/ModelHealth/Verdict", own), ua.NodeId(15428, 0)):
            with pytest.raises(BadUserAccessDenied):
                await client.get_node(node).write_value("trustworthy")
        with pytest.raises(BadUserAccessDenied):
            await client.nodes.objects.add_object(own, "Forged")
        with pytest.raises(BadUserAccessDenied):
            await client.delete_nodes([client.get_node(ua.NodeId(ARM, own))])
        with pytest.raises(BadUserAccessDenied):
            await client.nodes.server.call_method(ua.NodeId(ua.ObjectIds.Server_GetMonitoredItems), 1)
        with pytest.raises(ua.UaStatusCodeError):
            await client.uaclient.register_server(ua.RegisteredServer(ServerUri="urn:eve"))
        assert [each.ApplicationUri for each in await client.find_servers()] == ["urn:armident:opcua"]
        assert await model(client) == "emps"

    asked(url, question)


def revoke(folder: Path, authority: Authority, *names: str) -> None:
    """Give the server the revocation list of these names."""
    revoked = [certificate for name in names for certificate in read_certificates(folder / f"opcua.{name}.pem")]
    write_whole(folder / "server" / "authority.crl", authority.revocation_list(revoked), 0o644)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of keys: those of the server, and of clients of this plant and of another one of its name."""
    folder, now = tmp_path_factory.mktemp("keys"), datetime.now(UTC)
    authority, foreign = new_authority("plant", 30), new_authority("plant", 30)
    (folder / "server").mkdir()
    write_whole(folder / "server" / "authority.pem", pem_of(authority.certificate), 0o644)
    write_key(folder / "authority.key", authority.key)
    write_whole(folder / "authority.pem", pem_of(authority.certificate), 0o644)
    write_identity(folder / "server", authority.issue("opcua", ANY_CELL, "opcua.server", ("127.0.0.1",), 30))
    people = [(authority, name, now) for name in ("anna", "revoked", "leaver")]
    for who, name, begin in (*people, (foreign, "eve", now), (authority, "old", now - timedelta(40))):
        write_identity(folder, who.issue("opcua", ANY_CELL, f"opcua.{name}", (), 30, begin))
    revoke(folder, authority, "revoked")
    return folder


@pytest.fixture(scope="module")
def secured(cell: Path, keys: Path) -> Iterator[str]:
    """Address of a server that other machines reach."""
    with serving(cell, "--keys", keys / "server", listen="0.0.0.0:0") as (found, _):
        yield found


async def client_of(url: str, keys: Path, channel: str | None, user: str | None) -> Client:
    """A client with the certificates of its channel and of its user."""
    client = Client(url, timeout=20)
    if channel is not None:
        client.application_uri = f"urn:armident:opcua.{channel}"
        own = (keys / f"opcua.{channel}.pem", CertProperties(keys / f"opcua.{channel}.key", "pem"))
        server = keys / "server" / "opcua.server.pem"
        await client.set_security(SecurityPolicyBasic256Sha256, *own, server_certificate=server)
    if user is not None:
        await client.load_client_certificate(keys / f"opcua.{user}.pem")
        await client.load_private_key(keys / f"opcua.{user}.key", None, "pem")
    return client


def test_a_client_of_the_plant_reads_and_changes_nothing(secured: str, keys: Path) -> None:
    async def ask() -> None:
        async with await client_of(secured, keys, "anna", "anna") as client:
            assert await model(client) == "emps"
            with pytest.raises(BadUserAccessDenied):
                await client.nodes.objects.add_object(2, "Forged")

    asyncio.run(ask())


@pytest.mark.parametrize(
    ("channel", "user", "reason"),
    [
        (None, None, BadCertificateUntrusted), (None, "anna", BadCertificateUntrusted),
        ("anna", None, BadIdentityTokenRejected), ("eve", "eve", BadCertificateUntrusted),
        ("anna", "eve", BadCertificateUntrusted), ("eve", "anna", BadCertificateUntrusted),
        ("old", "old", BadCertificateUntrusted), ("anna", "revoked", BadCertificateUntrusted),
        ("revoked", "anna", BadCertificateUntrusted),
    ],
)  # fmt: skip
def test_nobody_else_signs_in(
    secured: str,
    keys: Path,
    channel: str | None,
    user: str | None,
    reason: type[ua.UaError],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Anonymous, without encryption, of another authority, expired, revoked: of the channel, of the user, or of both.

    The client asks although the server offers no such endpoint.
    """
    monkeypatch.setattr(Client, "find_endpoint", staticmethod(lambda endpoints, *_: endpoints[0]))

    async def ask() -> None:
        async with await client_of(secured, keys, channel, user):
            raise AssertionError("signed in")

    with pytest.raises(reason):
        asyncio.run(ask())


def test_a_certificate_that_is_only_stated_does_not_count(secured: str, keys: Path) -> None:
    """Eve has stolen the key of a user; her request for a session states the certificate of Anna's application."""
    (anna,) = read_certificates(keys / "opcua.anna.pem")

    async def ask() -> None:
        client = await client_of(secured, keys, "eve", "anna")
        send = client.uaclient.create_session

        async def state(params: ua.CreateSessionParameters) -> ua.CreateSessionResult:
            params.ClientCertificate = anna.public_bytes(Encoding.DER)
            return await send(params)

        client.uaclient.create_session = state
        await client.connect()

    with pytest.raises(BadCertificateUntrusted):
        asyncio.run(ask())


def test_a_client_that_is_revoked_is_signed_out(secured: str, keys: Path) -> None:
    async def read_on(client: Client) -> None:
        while True:
            await model(client)
            await asyncio.sleep(0.1)

    async def ask() -> None:
        async with await client_of(secured, keys, "anna", "anna") as anna:
            leaver = await client_of(secured, keys, "anna", "leaver")
            await leaver.connect()
            assert await model(leaver) == "emps"
            revoke(keys, read_authority(keys), "revoked", "leaver")
            with pytest.raises((ConnectionError, ua.UaError)):
                await asyncio.wait_for(read_on(leaver), LONGEST_S)
            assert await model(anna) == "emps"
            with suppress(ConnectionError, ua.UaError):
                await leaver.disconnect()

    asyncio.run(ask())


def test_sessions_beyond_the_limit_are_refused_until_others_end(url: str) -> None:
    async def crowd() -> int:
        clients, refused = [Client(url, timeout=20) for _ in range(SESSIONS + 3)], 0
        for client in clients:
            try:
                await client.connect()
            except ua.UaError:
                refused += 1
        for client in clients:
            with suppress(ua.UaError):
                await client.disconnect()
        return refused

    assert asyncio.run(crowd()) == 3
    assert asked(url, model) == "emps"


def test_requests_that_would_occupy_the_server_are_bounded(url: str) -> None:
    async def question(client: Client) -> None:
        intervals = (1e-6, math.nan, math.inf, 1000.0)
        assert len(intervals) == SUBSCRIPTIONS
        made = []
        for interval in intervals:
            params = ua.CreateSubscriptionParameters(RequestedPublishingInterval=interval)
            made.append(await client.uaclient.create_subscription(params, print))
        assert [each.RevisedPublishingInterval for each in made] == [FASTEST_MS, SLOWEST_MS, SLOWEST_MS, 1000.0]
        numbers = sorted(each.SubscriptionId for each in made)
        assert min(b - a for a, b in pairwise(numbers)) > 1, "those of others are not to be guessed"
        with pytest.raises(ua.UaStatusCodeError):
            await client.create_subscription(1000, Heard())
        with pytest.raises(ua.UaStatusCodeError):
            await client.read_values([client.nodes.server] * (NODES + 1))
        assert await model(client) == "emps"

    asked(url, question)


def test_a_session_lasts_no_longer_than_asked_and_not_for_ever(url: str) -> None:
    async def ask(wanted: float) -> float:
        client = Client(url, timeout=20)
        client.session_timeout = wanted
        async with client:
            return float(client.session_timeout)

    # A timer of NaN would wake again and again.
    assert [asyncio.run(ask(each)) for each in (math.nan, 1e12, 30_000.0)] == [120_000.0, 120_000.0, 30_000.0]


def hello(buffer: int = 65_535) -> bytes:
    """The first message of a client."""
    body = struct.pack("<IIIIIi", 0, buffer, buffer, 0, 0, -1)
    return b"HELF" + struct.pack("<I", 8 + len(body)) + body


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        b"\0" * 4096,
        hello()[:10],
        hello(1) * 2,
        b"OPNF\xff\xff\xff\x7f" + bytes(5 << 20),
        b"MSGF\x10\0\0\0" + bytes(8),
        hello() + b"OPNF\x20\0\0\0" + b"\xff" * 24,
        hello() * 2000,
    ],
    ids=["http", "zeros", "half", "tiny_buffers", "two_gigabytes", "no_channel", "open", "many"],
)
def test_garbage_does_not_stop_the_server(url: str, data: bytes) -> None:
    host = ("127.0.0.1", int(url.rstrip("/").rpartition(":")[2]))
    with socket.create_connection(host, 20) as connection:
        with suppress(ConnectionError):
            connection.sendall(data)
        assert asked(url, model) == "emps"


def test_a_client_that_announces_more_than_a_message_is_left(url: str) -> None:
    host = ("127.0.0.1", int(url.rstrip("/").rpartition(":")[2]))
    with socket.create_connection(host, LONGEST_S) as connection, pytest.raises(ConnectionError):
        connection.sendall(b"OPNF\xff\xff\xff\x7f" + bytes(100 << 20))


def test_a_signal_ends_the_server_in_order(cell: Path) -> None:
    with serving(cell) as (url, process):
        assert asked(url, model) == "emps"
        process.send_signal(signal.SIGTERM)
        _, stderr = process.communicate(timeout=LONGEST_S)
        assert (process.returncode, stderr) == (0, "")


def refused(*words: object) -> str:
    """Run the command, which ends with exit code 2; return its only line."""
    arguments = ["opcua", *map(str, words)]
    result = CliRunner().invoke(application(arguments), arguments)
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    return line


def test_mistakes_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = ("--config", plant.session(tmp_path, "press_2"))
    assert "expected HOST:PORT" in refused(*config, "--listen", "4840")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "already in use" in refused(*config, "--listen", f"127.0.0.1:{taken.getsockname()[1]}")
    monkeypatch.delenv("ARMIDENT_KEYS", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert "keys of a plant; run: armident keys init" in refused(*config, "--listen", "0.0.0.0:0")
    (tmp_path / "keys").mkdir()
    write_whole(tmp_path / "keys" / "authority.pem", pem_of(new_authority("plant", 30).certificate), 0o644)
    line = refused(*config, "--listen", "0.0.0.0:0", "--keys", tmp_path / "keys")
    assert "run where the authority is: armident keys enrol opcua --name NAME --address HOST" in line
