"""Attacks on a plant's router over TLS, none of which passes; beside each table, the rightful that does.

The router is ``zenohd`` if it is on the path, else a process with the router mode of the library that ``zenohd`` wraps.
Its configuration is the one that ``armident keys`` writes. Attackers have stolen keys, and no program of ours.
"""

import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.x509.oid import NameOID

from armident.configs import ConfigError, SessionConfig, config_path
from armident.configs.loading import parse
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.remote_commands import Command, send_command
from armident.daq.identity.access import tls_options
from armident.daq.identity.certificates import (
    Authority,
    Identity,
    Role,
    new_authority,
    pem_of,
    read_authority,
    read_identity,
    write_identity,
    write_whole,
)
from armident.daq.identity.folder import KeyFolder
from armident.daq.identity.plant import enrol, make_authority, revoke
from armident.daq.identity.signatures import Signer, new_nonce
from armident.daq.streaming import Keys, encode_event, open_session
from armident.identify.monitoring.worker.worker_receiver import WorkerReceiver
from tests.unit.daq.test_streaming import blocks

ROUTER = """
import sys, zenoh
config = zenoh.Config.from_file("router.json5")
config.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("adminspace/enabled", "true")
with zenoh.open(config):
    sys.stdin.read()
"""
FORGED = b"forged"
NOW = datetime.now(UTC)
A, B = "armident/a/tx40", "armident/b/tx40"
ENROLLED: list[tuple[Role, str | None, str | None]] = [
    ("capture", "a", None), ("worker", "a", None), ("operator", "a", "bert"), ("viewer", "a", "anna"),
    ("capture", "b", None), ("worker", "b", None), ("operator", "b", "carl"), ("viewer", None, "zoe"),
    ("viewer", "a", "revoked"),
]  # fmt: skip


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(condition: Callable[[], object], seconds: float = 5.0) -> bool:
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.02)
    return bool(condition())


def raw(place: str, tls: dict[str, Any] | None, **more: Any) -> zenoh.Config:
    """A client of Zenoh without our program: no access control, nothing signed."""
    config = zenoh.Config()
    entries: dict[str, Any] = {
        "mode": "client", "connect/endpoints": [place], "connect/timeout_ms": 2000, "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False, "timestamping/enabled": True, **more,
    }  # fmt: skip
    if tls is not None:
        entries["transport/link/tls"] = tls
    for key, value in entries.items():
        config.insert_json5(key, json.dumps(value))
    return config


@dataclass
class Plant:
    """Router and keys of a plant: ``folder`` of the authority, ``host`` as copied to its hosts, ``stolen`` keys."""

    folder: Path
    port: int = field(default_factory=free_port)

    @property
    def host(self) -> Path:
        return self.folder / "host"

    @property
    def stolen(self) -> Path:
        return self.folder / "stolen"

    @property
    def place(self) -> str:
        return f"tls/localhost:{self.port}"

    def session(self, cell: str, **options: Any) -> SessionConfig:
        shipped = parse(config_path("tx40_cell.yaml").read_text(), SessionConfig, "tx40_cell.yaml")
        own = shipped.zenoh.model_copy(
            update={"connect": (self.place,), "keys": self.host, "commands": True, **options}
        )
        return shipped.model_copy(update={"cell": cell, "zenoh": own, "robot": Path("tx40.yaml")})

    def tls(self, name: str) -> dict[str, Any]:
        folder = self.stolen if (self.stolen / f"{name}.pem").exists() else self.host
        return tls_options(f"{folder}/", name) | {"root_ca_certificate": str(self.folder / "authority.pem")}

    def attacker(self, name: str) -> zenoh.Session:
        return zenoh.open(raw(self.place, self.tls(name)))

    @contextmanager
    def router(self) -> Iterator[None]:
        place = self.place
        program = shutil.which("zenohd")
        command = [program, "-c", "router.json5", "-l", place] if program else [sys.executable, "-c", ROUTER, place]
        with subprocess.Popen(command, cwd=self.folder, stdin=subprocess.PIPE) as process:
            try:
                assert wait_for(self._listens, 20), "the router does not start"
                yield
            finally:
                process.terminate()

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0


@dataclass
class Stage:
    """A plant at work: capture of cell a, and a worker and a viewer that note what they hear."""

    plant: Plant
    capture: Publisher
    heard: list[tuple[str, bytes]] = field(default_factory=list)
    probes: int = 0

    def settle(self) -> None:
        """Wait until what was sent before has arrived where it may: a message of the capture comes through."""
        time.sleep(0.05)
        self.probes += 1
        probe = {"probe": self.probes}
        self.capture.health(probe)
        assert wait_for(lambda: any(b'"probe": %d}' % self.probes in payload for _, payload in self.heard))

    @contextmanager
    def by(self, name: str) -> Iterator[zenoh.Session]:
        """Open the session of an attacker, or of somebody who may; afterwards all that it sent has arrived."""
        with self.plant.attacker(name) as session:
            yield session
            self.settle()

    def hear(self, sample: zenoh.Sample) -> None:
        self.heard.append((str(sample.key_expr), bytes(sample.payload)))

    def forged(self) -> list[str]:
        return [key for key, payload in self.heard if payload == FORGED]


def issue(authority: Authority, folder: Path, name: str, role: Role = "capture", **how: Any) -> Identity:
    identity = authority.issue(role, "a", name, how.get("addresses", []), 9, how.get("now"))
    write_identity(folder, identity)
    return identity


def self_signed(folder: Path) -> None:
    """A certificate named capture.a of the plant that nobody has signed but its own key."""
    key, subject = (
        ec.generate_private_key(ec.SECP256R1()),
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "capture.a")]),
    )
    certificate = (
        x509.CertificateBuilder(subject, subject, key.public_key(), 7, NOW, NOW + timedelta(days=9)).sign(key, SHA256())
    )  # fmt: skip
    write_identity(folder, Identity("capture", "a", "self_signed", key, certificate))


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    plant = Plant(tmp_path_factory.mktemp("plant"))
    make_authority(plant.folder, "werk")
    enrol(plant.folder, "router", None, None, ["localhost"], 365)
    for role, cell, name in ENROLLED:
        enrol(plant.folder, role, cell, name, ["localhost"] if (role, cell) == ("capture", "a") else [], 365)
    plant.host.mkdir()
    plant.stolen.mkdir()
    for path in [*plant.folder.glob("*.pem"), *plant.folder.glob("*.*.key")]:
        shutil.copy(path, plant.host)
    revoke(plant.folder, "viewer.revoked")
    authority, foreign = read_authority(plant.folder), new_authority("werk", 9)
    issue(authority, plant.stolen, "expired", now=NOW - timedelta(days=10))
    issue(authority, plant.stolen, "not_yet_valid", now=NOW + timedelta(days=1))
    issue(foreign, plant.stolen, "foreign")
    issue(foreign, plant.stolen, "foreign_router", "router", addresses=["localhost"])
    issue(authority, plant.stolen, "worker_as_router", "worker", addresses=["localhost"])
    self_signed(plant.stolen)
    anna = read_identity(plant.host / "viewer.anna.pem")
    assert isinstance(anna.key, ec.EllipticCurvePrivateKey)
    made = issue(Authority(anna.key, anna.certificate), plant.stolen, "signed_by_a_viewer")
    write_whole(plant.stolen / "signed_by_a_viewer.pem", pem_of(made.certificate, anna.certificate), 0o644)
    with plant.router():
        yield plant


@pytest.fixture(scope="module")
def stage(plant: Plant) -> Iterator[Stage]:
    with ExitStack() as stack:
        session = plant.session("a")
        capture = Publisher(session, Keys("a", "tx40"))
        stack.callback(capture.close)
        assert capture.problem is None
        stage = Stage(plant, capture)
        worker = stack.enter_context(open_session(session, "observer", identity="worker"))
        viewer = stack.enter_context(open_session(plant.session("zoe"), "observer"))
        kept = [
            worker.declare_subscriber(f"{A}/{key}", stage.hear) for key in ("samples", "events", "result/*", "status")
        ]
        keys = ("samples", "events", "health", "status", "result/*")
        kept += [viewer.declare_subscriber(f"armident/*/*/{key}", stage.hear) for key in keys]
        # The probes are heard only when the declarations have reached the router.
        until = time.monotonic() + 10
        while not stage.heard and time.monotonic() < until:
            capture.health({"probe": 0})
            time.sleep(0.05)
        yield stage
        del kept


# Connections


@pytest.mark.parametrize("name", ["expired", "not_yet_valid", "foreign", "self_signed", "signed_by_a_viewer"])
def test_a_certificate_that_is_not_valid_opens_no_connection(plant: Plant, name: str) -> None:
    with pytest.raises(zenoh.ZError):
        plant.attacker(name)


def test_without_a_certificate_no_connection_opens(plant: Plant) -> None:
    with pytest.raises(zenoh.ZError):
        zenoh.open(raw(plant.place, {"root_ca_certificate": str(plant.folder / "authority.pem")}))
    with pytest.raises(zenoh.ZError):
        zenoh.open(raw(f"tcp/localhost:{plant.port}", None))


def test_a_client_refuses_a_router_of_another_host_name(plant: Plant) -> None:
    session = plant.session("a", connect=(f"tls/127.0.0.1:{plant.port}",))
    with pytest.raises(ConfigError, match="does the router run, and does armident keys check find no fault"):
        open_session(session, "observer")


@contextmanager
def rogue_router(plant: Plant, name: str) -> Iterator[tuple[zenoh.Session, str]]:
    place = f"tls/localhost:{free_port()}"
    config = raw(place, plant.tls(name), mode="router")
    config.insert_json5("connect/endpoints", "[]")
    config.insert_json5("listen/endpoints", f'["{place}"]')
    with zenoh.open(config) as router:
        yield router, place


def test_a_client_refuses_a_router_of_a_foreign_authority(plant: Plant) -> None:
    with (
        rogue_router(plant, "foreign_router") as (_, place),
        pytest.raises(ConfigError, match="cannot connect"),
    ):
        open_session(plant.session("a", connect=(place,)), "observer")


def test_a_certificate_of_another_role_makes_no_router(plant: Plant) -> None:
    stolen: list[bytes] = []
    with rogue_router(plant, "worker_as_router") as (router, place):
        taken = router.declare_subscriber(f"{A}/status", lambda sample: stolen.append(bytes(sample.payload)))
        with open_session(plant.session("a", connect=(place,)), "observer", identity="worker") as client:
            got: list[object] = []
            kept = client.declare_subscriber(f"{A}/samples", got.append)
            for _ in range(5):
                router.put(f"{A}/samples", FORGED)
                client.put(f"{A}/status", b"secret")
                time.sleep(0.05)
            assert not got
            assert not stolen
            del kept
        del taken


# Publishing


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("viewer.anna", f"{A}/samples"),
        ("viewer.anna", f"{A}/events"),
        ("viewer.anna", f"{A}/health"),
        ("viewer.anna", f"{A}/status"),
        ("viewer.anna", f"{A}/result/identification"),
        ("viewer.anna", "armident/a/*/samples"),
        ("viewer.anna", "armident/**"),
        ("viewer.anna", "**"),
        ("viewer.zoe", f"{A}/samples"),
        ("viewer.revoked", f"{A}/samples"),
        ("operator.bert", f"{A}/samples"),
        ("operator.bert", f"{A}/result/identification"),
        ("capture.a", f"{A}/result/identification"),
        ("capture.a", f"{B}/samples"),
        ("capture.b", f"{A}/samples"),
        ("capture.b", "armident/*/tx40/samples"),
        ("worker.a", f"{A}/samples"),
        ("worker.a", f"{A}/events"),
        ("worker.a", f"{A}/health"),
        ("worker.b", f"{A}/result/identification"),
    ],
)
def test_what_a_role_may_not_publish_arrives_nowhere(stage: Stage, name: str, key: str) -> None:
    with stage.by(name) as attacker:
        attacker.put(key, FORGED)
        attacker.delete(key)
        publisher = attacker.declare_publisher(key)
        publisher.put(FORGED)
    assert stage.forged() == []


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("capture.a", f"{A}/samples"),
        ("capture.a", f"{A}/events"),
        ("capture.b", f"{B}/health"),
        ("worker.a", f"{A}/status"),
        ("worker.a", f"{A}/result/identification"),
    ],
)
def test_what_a_role_may_publish_arrives(stage: Stage, name: str, key: str) -> None:
    content = f"{name} on {key}".encode()
    with stage.by(name) as sender:
        sender.put(key, content)
    assert (key, content) in stage.heard


# Commands


def ask(session: zenoh.Session, key: str, payload: bytes = b"", attachment: bytes | None = None) -> list[zenoh.Reply]:
    return list(session.get(key, payload=payload, attachment=attachment, timeout=1.0))


@pytest.mark.parametrize(
    ("name", "role", "key"),
    [
        ("viewer.anna", "viewer", f"{A}/command/stop"),
        ("viewer.anna", "viewer", f"{A}/command/reload"),
        ("viewer.anna", "viewer", f"{A}/command/mark"),
        ("viewer.anna", "viewer", f"{A}/command/save"),
        ("viewer.zoe", "viewer", "armident/*/*/command/stop"),
        ("viewer.revoked", "viewer", f"{A}/command/stop"),
        ("worker.a", "worker", f"{A}/command/stop"),
        ("capture.b", "capture", f"{A}/command/stop"),
        ("operator.carl", "operator", f"{A}/command/stop"),
        ("operator.carl", "operator", "armident/*/tx40/command/stop"),
    ],
)
def test_who_may_not_command_is_not_heard(stage: Stage, name: str, role: Role, key: str) -> None:
    signer = Signer(KeyFolder(stage.plant.host), role, "b" if name.endswith((".b", "carl")) else "a")
    with stage.by(name) as attacker:
        assert ask(attacker, key, attachment=signer.attachment(key, b"", new_nonce())) == []
    assert stage.capture.commands.pending() == []


def test_an_operator_commands_once_and_a_repetition_is_refused(stage: Stage) -> None:
    send_command(stage.plant.session("a"), "tx40", Command("stop"))
    assert stage.capture.commands.pending() == [Command("stop")]
    key, signer = f"{A}/command/stop", Signer(KeyFolder(stage.plant.host), "operator", "a")
    signed = signer.attachment(key, b"", new_nonce())
    with stage.by("operator.bert") as operator:
        answers = [ask(operator, at, attachment=each) for at, each in (
            (key, signed), (key, signed), (f"{A}/command/reload", signed), (key, None)
        )]  # fmt: skip
    assert [reply.ok is not None for replies in answers for reply in replies] == [True, False, False, False]
    assert stage.capture.commands.pending() == [Command("stop")]


# Reading


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("viewer.anna", "armident/b/*/samples"),
        ("viewer.anna", "armident/*/*/samples"),
        ("viewer.anna", "**"),
        ("viewer.revoked", f"{B}/samples"),
        ("worker.a", f"{B}/samples"),
        ("capture.a", f"{B}/samples"),
        ("operator.bert", f"{B}/samples"),
        ("capture.b", f"{B}/samples"),
        ("worker.b", "armident/b/tx40/health"),
    ],
)
def test_what_a_role_may_not_read_it_does_not_hear(stage: Stage, name: str, key: str) -> None:
    heard = read_by(stage, name, key, "capture.b", key if key.startswith(f"{B}/") else f"{B}/samples")
    assert heard == []


def test_the_worker_and_a_viewer_of_the_plant_read_the_cell(stage: Stage) -> None:
    for name, key in (("worker.b", f"{B}/samples"), ("viewer.zoe", "armident/*/*/samples")):
        assert read_by(stage, name, key, "capture.b", f"{B}/samples")


def read_by(stage: Stage, name: str, key: str, sender: str, sent: str) -> list[zenoh.Sample]:
    """Return the messages that arrive on a key while another session publishes."""
    heard: list[zenoh.Sample] = []
    with stage.by(sender) as capture, stage.by(name) as reader:
        kept = reader.declare_subscriber(key, heard.append)
        for _ in range(3):
            time.sleep(0.05)
            capture.put(sent, b"secret")
        del kept
    return heard


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("viewer.anna", f"{B}/result/identification"),
        ("viewer.anna", "armident/**"),
        ("operator.bert", f"{B}/result/identification"),
        ("worker.a", f"{B}/result/identification"),
        ("capture.b", f"{B}/result/identification"),
        ("viewer.revoked", f"{B}/result/identification"),
        ("operator.bert", "@/*/router/**"),
    ],
)
def test_what_a_role_may_not_ask_nobody_answers(stage: Stage, name: str, key: str) -> None:
    with stage.by("worker.b") as worker, stage.by(name) as attacker:
        kept = worker.declare_queryable(
            f"{B}/result/identification", lambda query: query.reply(query.key_expr, b"secret")
        )
        with stage.by("viewer.zoe") as viewer:
            # Rightful askers get the answer, hence an attacker without one was refused.
            assert wait_for(lambda: ask(viewer, f"{B}/result/identification"))
            assert ask(attacker, key) == []
        del kept


# Answers and liveliness in the name of others


@pytest.mark.parametrize(
    ("name", "key", "asker", "asked"),
    [
        ("viewer.anna", f"{A}/result/identification", "viewer.zoe", f"{A}/result/identification"),
        ("capture.a", f"{A}/result/identification", "viewer.zoe", f"{A}/result/identification"),
        ("worker.b", f"{A}/result/identification", "viewer.zoe", f"{A}/result/identification"),
        ("viewer.anna", f"{A}/command/*", "operator.bert", f"{A}/command/none"),
        ("worker.a", f"{A}/command/*", "operator.bert", f"{A}/command/none"),
        ("capture.b", f"{A}/command/*", "operator.bert", f"{A}/command/none"),
        ("viewer.anna", f"{A}/samples/@adv/pub/1/1/_", "worker.a", f"{A}/samples/@adv/**"),
        ("worker.a", f"{A}/samples/@adv/pub/1/1/_", "viewer.anna", f"{A}/samples/@adv/**"),
    ],
)
def test_nobody_answers_in_the_name_of_others(stage: Stage, name: str, key: str, asker: str, asked: str) -> None:
    def forge(query: zenoh.Query) -> None:
        query.reply(query.key_expr, FORGED)

    with stage.by(name) as attacker:
        kept = attacker.declare_queryable(key, forge)
        with stage.by(asker) as session:
            replies = ask(session, asked)
        del kept
    assert FORGED not in [bytes(reply.ok.payload) for reply in replies if reply.ok is not None]


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("viewer.anna", f"{A}/alive/worker"),
        ("operator.bert", f"{A}/alive/worker"),
        ("capture.a", f"{A}/alive/worker"),
        ("capture.a", f"{B}/alive/capture"),
        ("worker.a", f"{A}/alive/other"),
        ("capture.b", f"{A}/alive/capture2"),
        ("worker.a", f"{A}/samples/@adv/pub/1/1/_"),
    ],
)
def test_nobody_is_alive_in_the_name_of_others(stage: Stage, name: str, key: str) -> None:
    with stage.by(name) as attacker, stage.by("viewer.zoe") as viewer:
        token = attacker.liveliness().declare_token(key)
        time.sleep(0.1)
        alive = [
            str(reply.ok.key_expr)
            for below in ("alive/*", "samples/@adv/pub/**")
            for reply in viewer.liveliness().get(f"armident/*/*/{below}", timeout=1.0)
            if reply.ok is not None
        ]
        token.undeclare()
    assert key not in alive
    assert f"{A}/alive/capture" in alive  # The rightful one is there.


# Messages that pass the router, because their sender may publish the key, and are not what they seem


def test_forged_and_moved_messages_are_refused_by_the_worker(stage: Stage) -> None:
    plant, taken = stage.plant, list[bytes | None]()
    receiver = WorkerReceiver(
        plant.session("a"), Keys("a", "r2"), lambda data, _: taken.append(data), lambda data, _: taken.append(data),
        (1 << 20, 1 << 20),
    )  # fmt: skip
    receiver.check()
    event = encode_event("mark", {"name": "x"})
    folder = KeyFolder(plant.host)
    capture, worker, other = (
        Signer(folder, "capture", "a"),
        Signer(folder, "worker", "a"),
        Signer(folder, "capture", "b"),
    )
    here = "armident/a/r2/events"
    try:
        with plant.attacker("capture.a") as session:
            for attachment in (
                None,  # not signed
                b"ARMS" + bytes(80),  # no signature
                worker.attachment(here, event),  # by another role
                other.attachment("armident/b/r2/events", event),  # of another cell
                capture.attachment("armident/a/tx40/events", event),  # of another robot
                capture.attachment("armident/a/r2/samples", event),  # moved to another key
                capture.attachment(here, event + b" "),  # of other content
            ):
                session.put(here, event, attachment=attachment)
            session.put(here, event, attachment=capture.attachment(here, event))
            assert wait_for(lambda: taken)
            time.sleep(0.2)
    finally:
        receiver.close()
    assert taken == [event]


# The rightful


def test_a_late_worker_gets_history_and_recovers_what_it_missed(plant: Plant) -> None:
    """Through a router of its own, which stops while the capture goes on."""
    second = Plant(plant.folder)
    session, made = second.session("a"), [block for block in blocks(12) if block.layout.name == "samples"]
    taken: list[bytes] = []
    with ExitStack() as stack:
        with second.router():
            capture = Publisher(session, Keys("a", "tx40"))
            stack.callback(capture.close)
            for block in made[:4]:
                capture.offer(block)
            receiver = WorkerReceiver(
                session,
                Keys("a", "tx40"),
                lambda *_: None,
                lambda data, _: taken.append(data or b""),
                (1 << 20, 1 << 20),
            )
            stack.callback(receiver.close)

            def has_history() -> bool:
                receiver.check()  # It opens its session again if the router was slow.
                return len(taken) == 4

            assert wait_for(has_history, 20), f"{len(taken)} of 4 blocks of history, {capture.problem}"
            capture.offer(made[4])
            assert wait_for(lambda: len(taken) == 5, 20), "nothing live"
        for block in made[5:8]:
            capture.offer(block)
        time.sleep(0.3)
        assert len(taken) == 5
        with second.router():
            capture.offer(made[8])
            assert wait_for(lambda: len(taken) == 9, 20), f"{len(taken)} of 9 blocks"
    assert len(set(taken)) == 9


def test_a_capture_that_listens_itself_denies_as_the_router_does(plant: Plant) -> None:
    alone = Plant(plant.folder)
    heard: list[bytes] = []
    session = alone.session("a", connect=(), listen=(alone.place,), keys=plant.folder)
    with open_session(session, "capture") as capture:
        kept = [
            capture.declare_queryable(f"{A}/command/*", lambda query: query.reply(query.key_expr, b"accepted")),
            capture.declare_subscriber(f"{A}/status", lambda sample: heard.append(bytes(sample.payload))),
        ]
        with pytest.raises(zenoh.ZError):
            zenoh.open(raw(alone.place.replace("tls", "tcp"), None))
        read: dict[str, list[zenoh.Sample]] = {"viewer.anna": [], "capture.b": []}
        for name, got in read.items():
            with alone.attacker(name) as attacker:
                reader = attacker.declare_subscriber(f"{A}/samples", got.append)
                attacker.put(f"{A}/status", FORGED)
                assert ask(attacker, f"{A}/command/stop") == []
                for _ in range(20):
                    capture.put(f"{A}/samples", b"block")
                    time.sleep(0.02)
                reader.undeclare()
        with alone.attacker("operator.bert") as operator:
            assert wait_for(lambda: ask(operator, f"{A}/command/stop"))
        del kept
    assert heard == []
    assert [bool(got) for got in read.values()] == [True, False]


def test_a_second_capture_of_a_robot_is_refused_by_way_of_the_router(stage: Stage) -> None:
    with pytest.raises(ConfigError, match="another capture of cell a, robot tx40, is running"):
        Publisher(stage.plant.session("a"), Keys("a", "tx40"))


def test_a_second_authority_is_not_trusted_beside_that_of_the_plant(plant: Plant) -> None:
    """An attacker who trusts his own authority as well does not make the router trust it."""
    both = plant.stolen / "both.pem"
    own = new_authority("werk", 9)
    both.write_bytes((plant.folder / "authority.pem").read_bytes() + pem_of(own.certificate))
    made = issue(own, plant.stolen, "second_authority")
    write_whole(plant.stolen / "second_authority.pem", pem_of(made.certificate, own.certificate), 0o644)
    with pytest.raises(zenoh.ZError):
        zenoh.open(raw(plant.place, plant.tls("second_authority") | {"root_ca_certificate": str(both)}))


def test_a_certificate_that_ends_closes_its_connection(plant: Plant) -> None:
    issue(read_authority(plant.folder), plant.stolen, "ending", now=datetime.now(UTC) - timedelta(days=9, seconds=-4))
    with plant.attacker("ending") as session:
        assert wait_for(lambda: [*session.info.routers_zid()], 2)
        assert wait_for(lambda: not [*session.info.routers_zid()], 10)
