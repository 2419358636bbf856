"""Keys of a plant: what the command makes, finds and says, and which sessions may leave the machine."""

import json
import logging
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError
from armident.daq.cli import application
from armident.daq.identity.certificates import (
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
from armident.daq.identity.folder import KeyFolder
from armident.daq.identity.plant import (
    Countdown,
    certificate_ends,
    enrol,
    enrolled,
    findings,
    make_authority,
    missing,
    renew,
    revoke,
)
from armident.daq.streaming.zenoh_session import configuration
from tests.unit.daq.test_identity import der, now
from tests.unit.daq.test_streaming import cell


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    folder = tmp_path / "keys"
    make_authority(folder, "werk")
    enrol(folder, "router", None, None, ["router.example", "192.0.2.1"], 365)
    enrol(folder, "capture", "press_7", None, [], 365)
    enrol(folder, "worker", "press_7", None, [], 365)
    enrol(folder, "viewer", "press_7", "anna", [], 20)
    return folder


def run(*words: str | Path) -> tuple[int, str, str]:
    done = CliRunner().invoke(application(["keys"]), ["keys", *map(str, words)])
    return done.exit_code, done.stdout, done.stderr


def problems(folder: Path, **how: Any) -> list[str]:
    return [each.message for each in findings(folder, how.pop("now", now()), **how) if each.verdict == "failed"]


def test_a_plant_is_made_by_the_commands_and_says_who_may_do_what(tmp_path: Path) -> None:
    folder = ("--folder", tmp_path / "keys")
    code, said, _ = run("init", "--plant", "werk", *folder)
    assert code == 0
    assert "offline" in said
    code, said, _ = run("enrol", "capture", "--cell", "press_7", "--address", "192.0.2.7", *folder)
    assert code == 0
    assert "capture.press_7.pem, capture.press_7.key, authority.pem and authority.crl to /etc/armident/keys" in said
    assert "router.json5 to the host of the router" in said
    run("enrol", "viewer", "--name", "anna", "--cell", "press_7", *folder)
    run("enrol", "operator", "--name", "bert", *folder)
    code, said, _ = run("check", *folder)
    assert code == 0
    assert said.splitlines()[-3:] == [
        "capture.press_7 (capture of cell press_7): reads nothing; publishes samples, events, health, status; "
        "answers commands; sends nothing",
        "operator.bert (operator of all cells): reads samples, events, health, status, results; publishes nothing; "
        "answers nothing; sends commands",
        "viewer.anna (viewer of cell press_7): reads samples, events, health, status, results; publishes nothing; "
        "answers nothing; sends nothing",
    ]
    rows = json.loads(run("show", "--json", *folder)[1])
    assert [row["name"] for row in rows] == ["capture.press_7", "operator.bert", "viewer.anna"]
    assert rows[0]["addresses"] == ["192.0.2.7"]
    assert "capture.press_7  capture   press_7" in run("show", *folder)[1]
    assert (tmp_path / "keys" / "capture.press_7.key").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["init", "--plant", "werk"], "exists already"),
        (["init", "--plant", "a/b", "--folder", "new"], "--plant 'a/b': expected letters"),
        (["enrol"], "expected a role"),
        (["enrol", "vewer"], "no role 'vewer'; expected capture, worker"),
        (["enrol", "capture"], "--cell is missing"),
        (["enrol", "capture", "--name", "x"], "capture and worker are of one cell"),
        (["enrol", "viewer"], "--cell is missing, or --name"),
        (["enrol", "viewer", "--cell", "a/**"], "expected the name of a cell"),
        (["enrol", "viewer", "--name", "../x"], "--name '../x'"),
        (["enrol", "viewer", "--name", "x" * 51], "expected letters"),
        (["enrol", "capture", "--cell", "press_7"], "or: armident keys renew capture.press_7"),
        (["enrol", "worker", "--cell", "b", "--address", "é.example"], "expected an IP address or a DNS name"),
        (["enrol", "router", "--cell", "b"], "neither --cell nor --name"),
        (["enrol", "opcua", "--cell", "press_7"], "opcua has no --cell"),
        (["enrol", "opcua", "--name", "x", "--address", "urn:é"], "expected an IP address or a DNS name"),
        (["renew"], "expected a name, or --all"),
        (["renew", "viewer.otto"], "no viewer.otto.pem; armident keys show lists"),
        (["revoke", "viewer.otto"], "no viewer.otto.pem"),
        (["revoke", "authority"], "no authority.pem; armident keys show"),
        (["revoke", "router.werk"], "a router is not revoked: make a new authority"),
        (["list"], "no action 'list'; expected init, enrol"),
        (["show", "--folder", "nowhere"], "no such folder"),
    ],
)
def test_a_mistake_is_one_line_with_the_next_step(
    words: list[str], said: str, plant: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ARMIDENT_KEYS", str(plant))
    before = sorted(plant.iterdir())
    code, printed, error = run(*words)
    assert code == 2, error
    assert said in error
    assert error.count("\n") == 1
    assert not printed
    assert sorted(plant.iterdir()) == before


def test_without_the_key_of_the_authority_nothing_is_signed(plant: Path) -> None:
    (plant / "authority.key").unlink()
    code, _, error = run("enrol", "viewer", "--name", "otto", "--folder", plant)
    assert code == 2
    assert "authority.key" in error
    assert not (plant / "viewer.otto.pem").exists()


def spoil(folder: Path, how: str) -> None:
    name, key = folder / "capture.press_7.pem", folder / "capture.press_7.key"
    match how:
        case "open key":
            key.chmod(0o644)
        case "other key":
            shutil.copy(folder / "worker.press_7.key", key)
        case "no key":
            (folder / "authority.key").unlink()
            key.unlink()
        case "not PEM":
            name.write_text("x")
        case "foreign":
            write_identity(folder, new_authority("werk", 9).issue("capture", "press_7", "capture.press_7", [], 9))
        case "other name":
            name.rename(folder / "capture.a.pem")
            key.rename(folder / "capture.a.key")
        case "no authority":
            (folder / "authority.pem").unlink()
        case "router edited":
            (folder / "router.json5").write_text("{}")
        case "not in router":
            name.unlink()
        case "no router":
            (folder / "router.json5").unlink()


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("open key", "capture.press_7.key: other users may read this private key; run: chmod o="),
        ("other key", "the certificate does not belong to the key beside it"),
        ("no key", "capture.press_7.key: No such file"),
        ("not PEM", "capture.press_7.pem: expected certificates (PEM)"),
        ("foreign", "'capture.press_7': its certificate was issued by another authority"),
        ("other name", "is the certificate of capture.press_7; expected the name capture.press_7.pem"),
        ("no authority", "authority.pem: No such file"),
        ("router edited", "router.json5: does not match the enrolled names; run: armident keys router"),
        ("not in router", "router.json5: does not match"),
        ("no router", "router.json5: is missing"),
    ],
)
def test_check_finds_what_would_fail_later(plant: Path, how: str, said: str) -> None:
    assert problems(plant) == ["viewer.anna: valid until"] or not problems(plant)
    spoil(plant, how)
    assert any(said in message for message in problems(plant))
    code, printed, error = run("check", "--folder", plant)
    assert code == 1
    assert said in printed
    assert "connections fail, or will soon" in error
    assert json.loads(run("check", "--json", "--folder", plant)[1])["checks"]


@pytest.mark.parametrize(
    ("days", "verdict", "said"),
    [
        (0, "ok", "viewer.anna: valid until"),
        (12, "warning", "in 7 days; run where the authority is: armident keys renew viewer.anna"),
        (13, "failed", "in 6 days"),
        (21, "failed", "viewer.anna: the certificate expired on"),
        (-1, "failed", "viewer.anna: the certificate is valid from"),
    ],
)
def test_the_end_of_a_certificate_is_counted_down(tmp_path: Path, days: int, verdict: str, said: str) -> None:
    make_authority(tmp_path / "keys", "werk")
    enrol(tmp_path / "keys", "viewer", None, "anna", [], 20 if days else 365)
    found = findings(tmp_path / "keys", datetime.now(UTC) + timedelta(days=days, seconds=60))
    each = next(each for each in found if "viewer.anna" in each.message)
    assert (each.verdict, said in each.message) == (verdict, True)


def test_check_with_a_session_names_missing_roles_and_addresses(plant: Path) -> None:
    session = cell("press_7", listen=("tls/192.0.2.7:7447", "tls/0.0.0.0:7448", "tcp/127.0.0.1:1"))
    assert [each.message for each in missing(plant, session)] == [
        f"{name}: its certificate is not for 192.0.2.7; run: armident keys renew {name} --address 192.0.2.7"
        for name in ("capture.press_7", "worker.press_7")
    ]
    for role in ("capture", "worker"):
        renew(plant, f"{role}.press_7", ["192.0.2.7"], 365)
    assert list(missing(plant, session)) == []
    assert [(each.verdict, each.message.split("; run: ")[1]) for each in missing(plant, cell("b"))] == [
        ("failed", "armident keys enrol capture --cell b"),
        ("failed", "armident keys enrol worker --cell b"),
    ]
    (plant / "worker.press_7.pem").unlink()
    assert [each.verdict for each in missing(plant, session)] == ["warning"]
    code, said, _ = run("check", "--config", "tx40_cell.yaml", "--folder", plant)
    assert code == 1
    assert "no certificate of a capture of cell demo" in said


def test_a_renewal_keeps_name_role_cell_and_addresses_with_a_new_key(plant: Path) -> None:
    before = {each.name: each for each in enrolled(plant)}
    assert (
        run("renew", "--all", "--within", "30", "--folder", plant)[1].splitlines()[0] == "1 of 4 certificates renewed"
    )
    assert run("renew", "--all", "--folder", plant)[1].splitlines()[0] == "4 of 4 certificates renewed"
    for each in enrolled(plant):
        old = before[each.name]
        assert (each.role, each.cell, each.addresses) == (old.role, old.cell, old.addresses)
        assert each.certificate.public_key() != old.certificate.public_key()
    assert problems(plant) == []


def test_an_application_of_opc_ua_has_no_part_in_zenoh(plant: Path) -> None:
    code, said, _ = run("enrol", "opcua", "--name", "scada", "--address", "urn:scada.example:client", "--folder", plant)
    assert code == 0
    assert "opcua.scada.pem, opcua.scada.key, authority.pem and authority.crl" in said
    assert "opcua" not in (plant / "router.json5").read_text()
    renewed = renew(plant, "opcua.scada", (), 30)
    assert [each.addresses for each in enrolled(plant) if each.role == "opcua"] == [["urn:scada.example:client"]]
    assert read_identity(plant / "opcua.scada.pem").key.private_numbers() == renewed.key.private_numbers()
    assert problems(plant) == []
    words = (
        "opcua.scada: serves or reads the verdicts of all cells over OPC UA; publishes, reads and commands nothing else"
    )
    assert words in run("check", "--folder", plant)[1]


def test_the_ends_of_certificates_follow_a_renewal(plant: Path) -> None:
    session = cell("press_7", keys=plant)
    authority = read_certificates(plant / "authority.pem")[0].not_valid_after_utc.timestamp()
    for days in (365, 20):
        renewed = renew(plant, "capture.press_7", (), days).certificate.not_valid_after_utc
        assert abs(renewed - now() - timedelta(days=days)) < timedelta(hours=1)
        found = certificate_ends(session, "capture")
        assert found == {("capture.press_7",): renewed.timestamp(), ("authority",): authority}
    assert certificate_ends(cell("b", keys=plant), "capture") == {}
    assert certificate_ends(cell("b", keys=plant / "none"), "worker") == {}


def test_a_renewed_authority_still_trusts_the_former_one(plant: Path) -> None:
    old = read_identity(plant / "capture.press_7.pem")
    assert run("renew", "authority", "--folder", plant)[0] == 0
    new = renew(plant, "capture.press_7", (), 365)
    trusted = read_certificates(plant / "authority.pem")
    assert [len(trusted), problems(plant)] == [2, []]
    for identity in (old, new):
        assert identity_of(trusted_certificate(der(identity), trusted, now()))[2] == "capture.press_7"
    assert read_authority(plant).certificate == trusted[0]


def test_a_revoked_name_has_no_access_and_is_not_given_again(plant: Path) -> None:
    assert '"viewer.anna"' in (plant / "router.json5").read_text()
    revoke(plant, "viewer.anna")
    assert "viewer.anna" not in (plant / "router.json5").read_text()
    assert problems(plant) == []
    with pytest.raises(ConfigError, match=r"viewer\.anna was revoked; choose another --name"):
        enrol(plant, "viewer", "press_7", "anna", [], 365)


def test_all_certificates_of_a_revoked_name_are_refused_and_no_others(plant: Path) -> None:
    """Those before a renewal, and of a former authority, are valid until they end: a thief may have one of them."""
    stolen, other = read_identity(plant / "viewer.anna.pem"), read_identity(plant / "capture.press_7.pem")
    stolen_later = renew(plant, "viewer.anna", (), 30)
    folder = KeyFolder(plant)
    assert not folder.revoked()
    assert run("renew", "authority", "--folder", plant)[0] == 0
    stolen_last = renew(plant, "viewer.anna", (), 30)
    code, said, _ = run("revoke", "viewer.anna", "--folder", plant)
    assert (code, "keys/authority.crl is in the folder of keys" in said) == (0, True)
    for identity in (stolen, stolen_later, stolen_last):
        with pytest.raises(DataError, match=r"viewer\.anna: the certificate was revoked"):
            folder.trusted(der(identity), now())
    assert identity_of(folder.trusted(der(other), now()))[2] == "capture.press_7"
    # The list of the next authority has them, too.
    assert run("renew", "authority", "--folder", plant)[0] == 0
    with pytest.raises(DataError, match="was revoked"):
        folder.trusted(der(stolen), now())


@pytest.mark.parametrize("damage", ["foreign", "cut", "empty"])
def test_nobody_is_trusted_with_a_revocation_list_that_is_none_of_the_plant(plant: Path, damage: str) -> None:
    path, anna = plant / "authority.crl", read_identity(plant / "viewer.anna.pem")
    foreign = new_authority("werk", 30).revocation_list([])
    path.write_bytes({"foreign": foreign, "cut": path.read_bytes()[:-40], "empty": b""}[damage])
    with pytest.raises(ConfigError, match=r"authority\.crl: .*copy it again"):
        KeyFolder(plant).trusted(der(anna), now())


def test_a_certificate_does_not_outlive_its_authority(plant: Path) -> None:
    short = new_authority("werk", 100)
    write_whole(plant / "authority.pem", pem_of(short.certificate), 0o644)
    (plant / "authority.key").unlink()
    write_identity(plant, short.issue("viewer", "*", "viewer.x", [], 9))
    write_key(plant / "authority.key", short.key)
    made = enrol(plant, "viewer", None, "otto", [], 365)
    assert made.certificate.not_valid_after_utc <= short.certificate.not_valid_after_utc


def test_a_service_logs_the_countdown_once_a_day(plant: Path, caplog: pytest.LogCaptureFixture) -> None:
    renew(plant, "capture.press_7", (), 5)
    countdown = Countdown(cell("press_7", keys=plant))
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            countdown.check()
    assert [(each.levelname, each.message.split(";")[0][-10:]) for each in caplog.records] == [
        ("ERROR", " in 4 days"),
        ("WARNING", "in 19 days"),
    ]


# Sessions that leave the machine

FAR = "expected tls/HOST:PORT"

CA = '{root_ca_certificate: "a", connect_certificate: "c", connect_private_key: "k", enable_mtls: true'
ACCESS = 'access_control: {enabled: true, default_permission: "deny", rules: [], subjects: [], policies: []}'
QUIET = "scouting: {multicast: {enabled: false}}"
CLIENT = f'mode: "client", {QUIET}, connect: {{endpoints: ["tls/192.0.2.1:7447"]}}'


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"listen": ("tcp/0.0.0.0:7447",)}, f"tcp/0.0.0.0:7447: {FAR}; for its keys: armident keys enrol"),
        ({"listen": ("tcp/[::]:7447",)}, FAR),
        ({"connect": ("tcp/192.0.2.1:7447",)}, f"tcp/192.0.2.1:7447: {FAR}"),
        ({"connect": ("udp/router.example:7447",)}, FAR),
        ({"connect": ("tls/192.0.2.1:7447", "tcp/127.0.0.1:7447")}, "beside endpoints of other hosts"),
        ({"connect": ("tls/192.0.2.1:7447#enable_mtls=false",)}, "expected no options of certificates"),
        ({"connect": ("tls/192.0.2.1:7447#verify_name_on_connect=false",)}, "expected no options of certificates"),
        ({"listen": ("tls/0.0.0.0:7447",)}, "router.json5: no such file; who listens for other hosts needs it"),
        ({"connect": ("tls/192.0.2.1:7447",), "cell": "b"}, "no key of a capture of cell b; run where the authority"),
        ("{}", "multicast finds other hosts"),
        (f"{{{QUIET}}}", rf"tcp/\[::\]:0: {FAR}"),
        ('{scouting: {multicast: {enabled: true}}, listen: {endpoints: ["tcp/127.0.0.1:1"]}}', "multicast finds"),
        (f'{{{QUIET}, listen: {{endpoints: {{peer: ["tcp/192.0.2.1:1"]}}}}}}', FAR),
        (f'{{{QUIET}, mode: "client", connect: {{endpoints: [{{strategy: "allOf", locators: ["tcp/192.0.2.1:1"]}}]}}}}',
         FAR),
        (f"{{{CLIENT}, transport: {{link: {{tls: {CA}}}}}}}}}", "needs access_control.enabled"),
        (f'{{{CLIENT}, {ACCESS.replace("deny", "allow")}, transport: {{link: {{tls: {CA}}}}}}}}}',
         "needs access_control.default_permission: deny"),
        (f'{{{CLIENT}, {ACCESS}, transport: {{link: {{tls: {CA.replace("true", "false")}}}}}}}}}', "needs enable_mtls"),
        (f"{{{CLIENT}, {ACCESS}, transport: {{link: {{tls: {CA}, verify_name_on_connect: false}}}}}}}}",
         "needs verify_name_on_connect"),
        (f'{{{CLIENT}, {ACCESS}, transport: {{link: {{tls: {{root_ca_certificate: "a", enable_mtls: true}}}}}}}}',
         "needs connect_certificate, connect_private_key"),
    ],
)  # fmt: skip
def test_no_session_leaves_the_machine_without_identity(
    options: dict[str, Any] | str, said: str, plant: Path, tmp_path: Path
) -> None:
    host = hosted(plant, tmp_path)
    if isinstance(options, str):
        (tmp_path / "zenoh.json5").write_text(options)
        session = cell("press_7", config=tmp_path / "zenoh.json5", keys=host)
    else:
        session = cell(options.pop("cell", "press_7"), keys=host, **options)
    with pytest.raises(ConfigError, match=said):
        configuration(session, "capture")


def hosted(plant: Path, folder: Path) -> Path:
    """The folder of keys on the host of a cell."""
    host = folder / "host"
    host.mkdir()
    for name in (
        "authority.pem",
        "capture.press_7.pem",
        "capture.press_7.key",
        "worker.press_7.pem",
        "worker.press_7.key",
    ):
        shutil.copy(plant / name, host)
    return host


def test_keys_of_this_machine_alone_do_not_leave_it() -> None:
    with pytest.raises(ConfigError, match=r"other hosts need keys of the plant.*armident keys enrol capture --cell b"):
        configuration(cell("b", connect=("tls/192.0.2.1:7447",)), "capture")


def test_a_client_has_the_certificate_of_its_role_and_listens_to_the_router_alone(plant: Path, tmp_path: Path) -> None:
    host = hosted(plant, tmp_path)
    found = configuration(cell("press_7", connect=("tls/192.0.2.1:7447",), keys=host), "observer", identity="worker")

    def get(key: str) -> Any:
        return json.loads(found.get_json(key))

    assert [get("mode"), get("listen/endpoints"), get("connect/timeout_ms")] == ["client", [], 2000]
    tls = get("transport/link/tls")
    assert tls["root_ca_certificate"] == f"{host}/authority.pem"
    assert tls["connect_certificate"] == f"{host}/worker.press_7.pem"
    assert [tls[key] for key in ("enable_mtls", "verify_name_on_connect", "close_link_on_expiration")] == [True] * 3
    assert get("transport/link/protocols") == ["tls", "quic"]
    assert get("access_control")["subjects"][0]["cert_common_names"] == ["router.werk"]
    assert len(get("access_control")["subjects"]) == 1


def test_a_peer_that_listens_has_the_access_control_of_the_plant(plant: Path) -> None:
    found = configuration(cell("press_7", listen=("tls/0.0.0.0:7447",), keys=plant), "capture")
    router = zenoh.Config.from_file(str(plant / "router.json5"))
    assert found.get_json("access_control") == router.get_json("access_control")
    assert json.loads(found.get_json("listen/endpoints")) == ["tls/0.0.0.0:7447"]


def test_on_loopback_nothing_is_needed() -> None:
    found = configuration(cell("b"), "capture")
    assert json.loads(found.get_json("transport/link/tls"))["root_ca_certificate"] is None
    assert json.loads(found.get_json("access_control"))["enabled"] is False
