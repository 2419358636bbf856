"""Validation of the buses of a session, and messages for contradictions."""

from typing import Any

import pytest
from pydantic import ValidationError

from armident.configs import config_path, load_session
from armident.configs.schema.session import SessionConfig

FD = {"bitrate": 1_000_000, "fd": True, "data_bitrate": 5_000_000}


def session(**changes: Any) -> SessionConfig:
    """Two drives on two buses, changed."""
    eds = str(config_path("eds/cia402_servo.eds"))
    data: dict[str, Any] = {
        "schema": "armident/session/1",
        "cell": "two",
        "robot": "tx40.yaml",
        "buses": [{"channel": "can0"}, {"channel": "can1"}],
        "drives": [
            {"joint": "joint_1", "node_id": 1, "eds": eds, "bus": "can0"},
            {"joint": "joint_2", "node_id": 1, "eds": eds, "bus": "can1"},
        ],
        "streams": {"samples": {"tpdo": 1, "objects": ["position", "current"]}},
    }
    return SessionConfig.model_validate(data | changes)


def test_drives_of_two_buses_may_have_the_same_node() -> None:
    found = session()
    assert [found.bus_of(drive).channel for drive in found.drives] == ["can0", "can1"]
    assert [[d.joint for d in found.drives_on(bus)] for bus in found.all_buses] == [["joint_1"], ["joint_2"]]


def test_a_session_with_one_bus_is_as_it_was_written() -> None:
    found = load_session("tx40_cell.yaml")
    assert [bus.channel for bus in found.all_buses] == ["vcan0"]
    assert {drive.bus for drive in found.drives} == {None}


def test_a_session_comes_back_from_the_text_that_a_recording_keeps() -> None:
    for found in (session(emcy_texts={0xFF01: "battery low"}), load_session("tx40_one_fd.yaml")):
        assert SessionConfig.model_validate_json(found.model_dump_json(by_alias=True)) == found


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"buses": [{"channel": "can0"}, {"channel": "can0"}]}, "channel of its own"),
        ({"buses": [{"channel": "can0"}, {"channel": "can2"}]}, "'can1' is not among the buses"),
        ({"buses": [{"channel": f"can{k}"} for k in range(3)]}, "no drive is on can2"),
        ({"buses": [{"channel": "can0"}], "drives": session().model_dump(by_alias=True)["drives"]}, "not among"),
        (
            {"buses": [{"channel": "can0", "interface": "udp_multicast"}, {"channel": "can1"}]},
            "need interface socketcan",
        ),
        ({"buses": [{"channel": "can0", "fd": True, "bitrate": 1000}, {"channel": "can1"}]}, "has both or none"),
        ({"buses": [{"channel": "can0", "data_bitrate": 1000}, {"channel": "can1"}]}, "only a bus with fd"),
        ({"sync": {"source": "kernel"}}, "they drift apart"),
        ({"streams": {"samples": {"tpdo": 1, "pack": 7, "objects": ["position"]}}}, "7 does not divide"),
        (
            {
                "streams": session().model_dump()["streams"]
                | {"d": {"tpdo": 2, "every": 5, "pack": 5, "objects": ["demand"]}}
            },
            "pack needs every: 1",
        ),
    ],
)
def test_contradictions_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        session(**changes)


def test_several_drives_need_to_say_their_bus() -> None:
    drives = session().model_dump(by_alias=True)["drives"]
    with pytest.raises(ValidationError, match=r"drives\[1\].bus: expected one of can0, can1"):
        session(drives=[drives[0], drives[1] | {"bus": None}])


def test_the_kernel_sends_sync_on_one_bus_without_set_points() -> None:
    one = {"buses": [{"channel": "can0"} | FD], "drives": session().model_dump(by_alias=True)["drives"][:1]}
    assert session(**one, sync={"source": "kernel"}).sync.source == "kernel"
    with pytest.raises(ValidationError, match="set points go out behind SYNC"):
        session(**one, sync={"source": "kernel"}, setpoints={"trajectory": "any.yaml"})
    with pytest.raises(ValidationError, match="only who sends SYNC"):
        session(**one, sync={"source": "kernel", "role": "consumer"})
