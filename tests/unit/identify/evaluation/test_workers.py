"""The suite's processes and its file of results."""

import json
import os
import signal
import threading
from pathlib import Path

import pytest

from armident.configs import ArmidentError, DataError
from armident.identify.evaluation.process import Room
from armident.identify.evaluation.store import Store, code_version
from armident.identify.evaluation.workers import DIAGNOSIS, PLANT

EMPS = {
    "robot": "emps.yaml", "trajectory": "trajectories/emps_excitation.yaml", "repeats": 1, "period": 1e-3, "seed": 1,
}  # fmt: skip


def spring(stiffness: object) -> dict[str, object]:
    return {
        "effect": "joint_spring", "joint": "joint_1", "other": None, "parameters": {"stiffness": stiffness},
        "truth": {"ks": "stiffness"}, "strength": 2.0,
    }  # fmt: skip


def test_a_plant_makes_recordings_and_evaluates_strengths_relative_to_its_joint(tmp_path: Path) -> None:
    plant = Room(PLANT, tmp_path / "plant.log")
    try:
        answer = plant.ask({"id": 1, **EMPS, "effects": [spring("s * fc")], "out": str(tmp_path / "a.mcap")}, 240)
        assert answer["truth"] == [{"ks": pytest.approx(2 * 20.3935)}]
        assert Path(answer["recording"]).stat().st_size > 100_000
        with pytest.raises(ArmidentError, match=r"joint_spring of joint_1: parameters.stiffness: 's \* fd': unknown"):
            plant.ask({"id": 2, **EMPS, "effects": [spring("s * fd")], "out": str(tmp_path / "b.mcap")}, 60)
        assert not (tmp_path / "b.mcap").exists()
    finally:
        plant.close()


def test_a_room_that_dies_is_an_error_of_its_request_and_starts_again_for_the_next(tmp_path: Path) -> None:
    room = Room(DIAGNOSIS, tmp_path / "diagnosis.log")
    refused = {"id": 1, "do": "nothing", "recording": "none.mcap", "robot": "emps.yaml"}
    try:
        with pytest.raises(ArmidentError, match=r"none\.mcap"):
            room.ask(refused, 120)
        process = room._process
        assert process is not None
        os.kill(process.pid, signal.SIGSTOP)
        killer = threading.Timer(0.2, os.kill, (process.pid, signal.SIGKILL))
        killer.start()
        with pytest.raises(ArmidentError, match=r"died \(exit code -9\)"):
            room.ask(refused, 60)
        killer.join()
        with pytest.raises(ArmidentError, match=r"none\.mcap"):
            room.ask(refused, 120)
    finally:
        room.close()


def test_a_room_that_has_grown_too_large_answers_and_starts_afresh_for_the_next(tmp_path: Path) -> None:
    unknown = {"id": 1, "do": "nothing", "recording": "none.mcap", "robot": "emps.yaml"}
    for largest, afresh in ((1 << 20, True), (64 << 30, False)):
        room = Room(DIAGNOSIS, tmp_path / "diagnosis.log", largest)
        try:
            with pytest.raises(ArmidentError, match=r"none\.mcap"):
                room.ask(unknown, 120)
            assert (room._process is None) == afresh
            with pytest.raises(ArmidentError, match=r"none\.mcap"):
                room.ask(unknown, 120)
        finally:
            room.close()


def test_a_room_that_does_not_answer_in_time_is_ended(tmp_path: Path) -> None:
    room = Room(DIAGNOSIS, tmp_path / "diagnosis.log")
    try:
        with pytest.raises(ArmidentError, match=r"no answer within 0 s"):
            room.ask({"id": 1, "do": "nothing", "recording": "none.mcap", "robot": "emps.yaml"}, 0.0)
        assert room._process is None
    finally:
        room.close()


def test_results_are_found_again_by_the_code_that_made_them_only(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    store = Store(path, "one")
    store.add({"key": "a", "document": {}})
    store.add({"key": "b", "error": "it broke"})
    again = Store(path, "one")
    assert again.get("a") is not None
    assert again.get("b") is None
    assert (again.failure("b") or {})["error"] == "it broke"
    assert Store(path, "two").get("a") is None
    assert Store(path, "two", any_version=True).get("a") is not None


def test_results_stay_while_only_what_cannot_change_them_does(tmp_path: Path) -> None:
    def write(name: str, content: str) -> str:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
        return code_version(tmp_path)

    first = write("identify/search.py", "a = 1")
    for name in (
        "identify/report/page.py",
        "configs/suites/suite.yaml",
        "identify/evaluation/tables.py",
        "identify/notes.md",
    ):
        assert write(name, "b = 2") == first, name
    versions = [
        write(name, "b = 2") for name in ("identify/search.py", "configs/robots/emps.yaml", "virtual_robot/noise.py")
    ]
    assert len({first, *versions}) == 4


def test_the_line_that_a_stopped_run_left_torn_is_dropped_and_any_other_is_told(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    whole = json.dumps({"key": "a", "document": {}, "code": "one"})
    path.write_text(f'{whole}\n{{"key": "b", "docu', encoding="utf-8")
    store = Store(path, "one")
    store.add({"key": "c", "document": {}})
    assert [json.loads(line)["key"] for line in path.read_text(encoding="utf-8").splitlines()] == ["a", "c"]
    path.write_text(f"nonsense\n{whole}\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"results\.jsonl:1: not JSON"):
        Store(path, "one")
