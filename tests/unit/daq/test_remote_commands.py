"""Commands over Zenoh: permitted ones arrive, others are refused with a reason."""

import time
import uuid
from collections.abc import Sequence
from pathlib import Path

import pytest
import zenoh

from armident.configs import ConfigError, DataError, SessionConfig, config_path
from armident.configs.loading import parse
from armident.daq.capture.remote_commands import Command, Commands, send_command
from armident.daq.identity.certificates import Role
from armident.daq.identity.folder import KeyFolder, key_folder
from armident.daq.identity.signatures import Signer, new_nonce, signer_for, trust_for
from armident.daq.streaming import Keys, open_session


def session(commands: bool) -> SessionConfig:
    shipped = parse(config_path("tx40_cell.yaml").read_text(), SessionConfig, "tx40_cell.yaml")
    options = shipped.zenoh.model_copy(update={"commands": commands})
    return shipped.model_copy(
        update={"cell": f"remote_{uuid.uuid4().hex[:8]}", "zenoh": options, "robot": Path("tx40.yaml")}
    )


def declare(commands: Commands, own: zenoh.Session, cell: SessionConfig) -> None:
    commands.declare(own, signer_for(cell, "capture"), trust_for(cell, Keys(cell.cell, "tx40").base))


def test_commands_arrive_in_order_with_their_texts() -> None:
    cell = session(True)
    with open_session(cell, "capture") as own:
        commands = Commands(Keys(cell.cell, "tx40"), True)
        declare(commands, own, cell)
        for command in (Command("mark", "gripper changed"), Command("save"), Command("stop")):
            send_command(cell, "tx40", command)
        assert commands.pending() == [Command("mark", "gripper changed"), Command("save"), Command("stop")]
        assert commands.pending() == []
        with pytest.raises(DataError, match="a text of 501 bytes"):
            send_command(cell, "tx40", Command("mark", "x" * 501))
        assert commands.pending() == []


def test_the_number_of_waiting_commands_is_limited() -> None:
    cell = session(True)
    with open_session(cell, "capture") as own:
        commands = Commands(Keys(cell.cell, "tx40"), True)
        declare(commands, own, cell)
        with open_session(cell, "observer") as flooding:
            querier = flooding.declare_querier(Keys(cell.cell, "tx40").command("mark"), timeout=5.0)
            until = time.monotonic() + 10
            while not querier.matching_status and time.monotonic() < until:
                time.sleep(0.01)
            signer, key = signer_for(cell, "operator"), Keys(cell.cell, "tx40").command("mark")
            signed = [signer.attachment(key, b"x", new_nonce()) for _ in range(100)]
            refused = [reply.err for each in signed for reply in querier.get(payload=b"x", attachment=each)]
        assert len(commands.pending()) == 32
        assert (
            bytes(next(err for err in refused if err is not None).payload)
            == b"32 commands are waiting already; try again later"
        )
        assert commands.pending() == []


def test_commands_are_refused_if_the_session_does_not_permit_them() -> None:
    cell = session(False)
    with open_session(cell, "capture") as own:
        commands = Commands(Keys(cell.cell, "tx40"), cell.zenoh.commands)
        declare(commands, own, cell)
        with pytest.raises(DataError, match=r"commands are not enabled; set zenoh\.commands"):
            send_command(cell, "tx40", Command("stop"))
        assert commands.pending() == []


def test_a_command_without_a_capture_is_a_configuration_error() -> None:
    begin = time.monotonic()
    with pytest.raises(ConfigError, match=r"no capture of cell remote_.* answers"):
        send_command(session(True), "tx40", Command("stop"), answer_s=0.5)
    assert time.monotonic() - begin < 30


def asked(cell: SessionConfig, commands: Commands, attachments: Sequence[bytes], key: str | None = None) -> list[str]:
    """Return the answers to a command ``stop`` with each of these attachments, asked on a key."""
    of_stop, answers = Keys(cell.cell, "tx40").command("stop"), []
    with open_session(cell, "observer") as observer:
        until, found = time.monotonic() + 10, list[zenoh.Reply]()
        while not found and time.monotonic() < until:
            found = list(observer.get(of_stop, payload=b"x"))
        for attachment in attachments:
            for reply in observer.get(key or of_stop, attachment=attachment):
                answer = reply.err if reply.ok is None else reply.ok
                assert answer is not None
                answers.append(bytes(answer.payload).decode())
    return answers


def test_only_a_fresh_command_of_an_operator_counts_and_it_counts_once(tmp_path: Path) -> None:
    cell = session(True)
    key, plant, stop = Keys(cell.cell, "tx40").command("stop"), key_folder(), new_nonce()
    once = signer_for(cell, "operator").attachment(key, b"", stop)
    early = Signer(plant, "operator", "*", lambda: time.time_ns() - 60 * 10**9).attachment(key, b"", new_nonce())
    late = Signer(plant, "operator", "*", lambda: time.time_ns() + 60 * 10**9).attachment(key, b"", new_nonce())
    foreign = Signer(KeyFolder(tmp_path / "foreign", local=True), "operator", cell.cell)
    wrong = [
        (b"ARMS", "the attachment is no signature"),
        (signer_for(cell, "viewer").attachment(key, b"", new_nonce()), "the role viewer may not ask it"),
        (signer_for(cell, "capture").attachment(key, b"", new_nonce()), "the role capture may not ask it"),
        (foreign.attachment(key, b"", new_nonce()), "issued by another authority"),
        (signer_for(cell, "operator").attachment(key, b"y", new_nonce()), "does not fit"),
        (signer_for(cell, "operator").attachment(key.replace("stop", "save"), b"", new_nonce()), "does not fit"),
        (signer_for(cell, "operator").attachment(key, b""), "received before"),
        (early, "s off the clock"),
        (late, "s off the clock"),
        (once, "accepted"),
        (once, "received before"),
    ]
    with open_session(cell, "capture") as own:
        commands = Commands(Keys(cell.cell, "tx40"), True)
        # As if it had begun before: the time of `once`.
        commands._began_ns -= 10**9
        declare(commands, own, cell)
        answers = asked(cell, commands, [attachment for attachment, _ in wrong])
        assert commands.pending() == [Command("stop")]
        everywhere = "armident/*/*/command/stop"
        others = signer_for(cell, "operator").attachment(everywhere, b"", new_nonce())
        (refused,) = asked(cell, commands, [others], everywhere)
        assert "not below" in refused
        assert commands.pending() == []
    for (_, expected), answer in zip(wrong, answers, strict=True):
        assert expected in answer
    # A capture that was restarted does not remember the command, but began after it.
    with open_session(cell, "capture") as own:
        commands = Commands(Keys(cell.cell, "tx40"), True)
        declare(commands, own, cell)
        (refused,) = asked(cell, commands, [once])
        assert "older than this capture" in refused
        assert commands.pending() == []


@pytest.mark.parametrize("role", [None, "worker"])
def test_an_answer_that_is_not_of_the_capture_is_refused(role: Role | None) -> None:
    cell = session(True)

    def answer(query: zenoh.Query) -> None:
        with query:
            key = str(query.key_expr)
            signed = None if role is None else signer_for(cell, role).attachment(key, b"accepted")
            query.reply(key, b"accepted", attachment=signed)

    with open_session(cell, "capture") as stranger:
        declared = stranger.declare_queryable(Keys(cell.cell, "tx40").command("*"), answer)
        with pytest.raises(DataError, match="an answer that is not of the capture"):
            send_command(cell, "tx40", Command("stop"))
        declared.undeclare()
