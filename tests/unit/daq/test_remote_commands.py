"""Commands over Zenoh: permitted ones arrive, others are refused with a reason."""

import time
import uuid
from pathlib import Path

import pytest
import zenoh

from armident.configs import ConfigError, DataError, SessionConfig, config_path
from armident.configs.loading import parse
from armident.daq.capture.remote_commands import Command, Commands, send_command
from armident.daq.identity.signatures import new_nonce, signer_for, trust_for
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
