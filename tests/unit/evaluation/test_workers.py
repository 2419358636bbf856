"""Processes of the suite and its file of results."""

import json
import math
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from armident.configs import ArmidentError, ConfigError, DataError, load_robot
from armident.identify.documents.diagnosis import DiagnosisDocument
from tests.evaluation import workers
from tests.evaluation.cases import Case
from tests.evaluation.plants.two_robots import simulate
from tests.evaluation.process import ByName, WorkerProcess
from tests.evaluation.store import CaseResult, Store, code_version
from tests.evaluation.tasks import DiagnosisTask, diagnose_file, reduced_model
from tests.evaluation.workers import CaseRunner

EMPS = {
    "robot": "emps.yaml", "trajectory": "trajectories/emps_excitation.yaml", "repeats": 1, "period": 1e-3, "seed": 1,
}  # fmt: skip
NO_FILE = DiagnosisTask(Path("none.mcap"), "emps.yaml")


def spring(stiffness: object) -> dict[str, object]:
    return {
        "effect": "joint_spring", "joint": "joint_1", "other": None, "parameters": {"stiffness": stiffness},
        "truth": {"ks": "stiffness"}, "strength": 2.0,
    }  # fmt: skip


@pytest.fixture
def refusing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the simulation by a plant that starts faster, for tests of the runner only."""
    monkeypatch.setattr(workers, "VIRTUAL_ROBOT", ByName("tests.fixtures.refusing_plant:simulate"))


@pytest.mark.slow
def test_a_plant_simulates_recordings_and_evaluates_strengths_relative_to_its_joint(tmp_path: Path) -> None:
    recording = tmp_path / "a.mcap"
    answer = simulate({**EMPS, "effects": [spring("s * fc")], "out": str(recording)})
    assert answer["truth"] == [{"ks": pytest.approx(2 * 20.3935)}]
    assert recording.stat().st_size > 100_000
    with pytest.raises(ConfigError, match=r"joint_spring of joint_1: parameters.stiffness: 's \* fd': unknown"):
        simulate({**EMPS, "effects": [spring("s * fd")], "out": str(tmp_path / "b.mcap")})
    assert not (tmp_path / "b.mcap").exists()


@pytest.mark.slow
def test_a_function_that_only_the_process_imports_is_called_by_its_name(tmp_path: Path) -> None:
    plant = WorkerProcess("plant", tmp_path / "plant.log")
    try:
        with pytest.raises(ArmidentError, match=r"plant: ConfigError: none\.yaml"):
            plant.run(ByName("tests.fixtures.refusing_plant:simulate"), {"robot": "none.yaml"}, 120)
    finally:
        plant.close()


def gone(pid: int) -> bool:
    """Wait for the end of a process."""
    until = time.monotonic() + 20
    while Path(f"/proc/{pid}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    return not Path(f"/proc/{pid}").exists()


@pytest.mark.slow
def test_a_diagnosis_worker_that_dies_or_hangs_fails_one_task_and_is_replaced(tmp_path: Path) -> None:
    diagnosis = WorkerProcess("diagnosis", tmp_path / "diagnosis.log")
    try:
        assert diagnosis.run(abs, -2, 120) == 2
        first = diagnosis.pid
        assert first is not None
        killer = threading.Timer(0.2, os.kill, (first, signal.SIGKILL))
        killer.start()
        with pytest.raises(ArmidentError, match=r"diagnosis: the worker process ended; see .*diagnosis\.log"):
            diagnosis.run(time.sleep, 60, 60)
        killer.join()
        assert diagnosis.run(os.path.basename, "a/b", 120) == "b"
        second = diagnosis.pid
        assert second not in (None, first)
        with pytest.raises(ArmidentError, match="diagnosis: no result within 0 s"):
            diagnosis.run(time.sleep, 60, 0.3)
        assert diagnosis.pid is None
        assert gone(second or 0)
        with pytest.raises(ArmidentError, match=r"diagnosis: ConfigError: none\.yaml"):
            diagnosis.run(load_robot, "none.yaml", 120)
    finally:
        diagnosis.close()


def test_the_task_of_a_missing_recording_fails_with_its_name() -> None:
    with pytest.raises((DataError, ConfigError), match=r"none\.mcap"):
        diagnose_file(NO_FILE)


@pytest.mark.slow
def test_a_diagnosis_worker_that_exceeds_its_memory_limit_is_replaced_after_its_result(tmp_path: Path) -> None:
    for limit, ended in ((1 << 20, True), (64 << 30, False)):
        diagnosis = WorkerProcess("diagnosis", tmp_path / "diagnosis.log", limit)
        try:
            assert diagnosis.run(abs, -2, 120) == 2
            assert (diagnosis.pid is None) == ended
        finally:
            diagnosis.close()


@pytest.mark.slow
def test_an_unexpected_error_of_a_task_is_its_result_and_its_trace_is_in_the_log(tmp_path: Path) -> None:
    diagnosis = WorkerProcess("diagnosis", tmp_path / "diagnosis.log")
    try:
        with pytest.raises(ArmidentError, match="diagnosis: ValueError: math domain error"):
            diagnosis.run(math.sqrt, -1.0, 120)
        assert diagnosis.run(math.sqrt, 4.0, 120) == 2.0
    finally:
        diagnosis.close()
    assert "Traceback" in (tmp_path / "diagnosis.log").read_text()


def test_a_stopped_worker_fails_its_task_and_starts_no_other(tmp_path: Path) -> None:
    diagnosis = WorkerProcess("diagnosis", tmp_path / "diagnosis.log")
    killer = threading.Timer(0.5, diagnosis.kill)
    killer.start()
    try:
        for _ in range(2):
            with pytest.raises(ArmidentError, match="the worker process ended"):
                diagnosis.run(time.sleep, 60, 60)
    finally:
        diagnosis.close()
        killer.join()


@pytest.mark.slow
@pytest.mark.usefixtures("refusing")
def test_the_failure_of_a_case_is_its_result_and_the_run_continues(tmp_path: Path) -> None:
    cases = [Case("clean", None, "emps", f"no_{k}.yaml", str(EMPS["trajectory"]), 1, 1e-3, 1) for k in range(2)]
    store = Store(tmp_path / "results.jsonl", "one")
    seen: list[tuple[Case, CaseResult]] = []
    CaseRunner(store, tmp_path, 1).run(cases, lambda case, result: seen.append((case, result)))
    assert [case for case, _ in seen] == cases
    for case, result in seen:
        assert result == store.failure(case.key)
        assert case.config in (result.error or "")
    CaseRunner(store, tmp_path, 1).run(cases, lambda case, result: seen.append((case, result)), time.monotonic())
    assert len(seen) == 2


def test_a_part_of_the_model_is_left_out() -> None:
    tx40 = load_robot("tx40.yaml")
    assert reduced_model(tx40, None, ()) is tx40
    assert reduced_model(tx40, "couplings", ()).couplings == ()
    reduced = reduced_model(tx40, "rotor_inertia", ("joint_2",))
    assert [joint.rotor_inertia for joint in reduced.joints].count(False) == 1
    with pytest.raises(ConfigError, match="leave_out: expected rotor_inertia or couplings, found 'gravity'"):
        reduced_model(tx40, "gravity", ())


def document(schema: str = "armident/diagnosis/2", **more: Any) -> dict[str, Any]:
    """A diagnosis as earlier versions of the suite stored it."""
    gap = {"all": 1.0, "by_joint": {"joint_1": 1.0}, "rms": {"joint_1": 0.1}}
    both = {"before": gap, "after": gap}
    return {
        "schema": schema, "robot": "emps", "verdict": "no_gap", "findings": [], "unexplained": [],
        "gap": {"train": both, "validation": both}, "noise_floor": gap, "recommended_experiment": None,
        "timing_s": {"total": 1.0}, "warnings": [], **more,
    }  # fmt: skip


def test_results_are_used_with_the_code_that_produced_them_only(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    store = Store(path, "one")
    diagnosis = DiagnosisDocument.model_validate({**document(), "recordings": [], "versions": {}, "model": None})
    stored = store.add(
        CaseResult(key="a", case="A", truth=[{"ks": 1.5}], document=diagnosis, seconds={"diagnose": 2.0})
    )
    store.add(CaseResult(key="b", error="it broke"))
    again = Store(path, "one")
    assert again.get("a") == stored
    assert again.get("b") is None
    failure = again.failure("b")
    assert failure is not None
    assert failure.error == "it broke"
    with pytest.raises(DataError, match="no diagnosis: it broke"):
        _ = failure.diagnosis
    assert Store(path, "two").get("a") is None
    assert Store(path, "two", any_version=True).get("a") is not None
    line = json.loads(path.read_text(encoding="utf-8").splitlines()[0])
    assert document().items() <= line["document"].items()
    keys = {field.alias or name for name, field in DiagnosisDocument.model_fields.items()}
    assert line["document"].keys() == keys - {"recordings", "versions", "model", "provenance", "signature"}


def test_a_line_that_is_no_result_is_named(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps({"key": "a", "document": {"verdict": "fine"}, "code": "one"}) + "\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"results\.jsonl:1: document\.\w+: .*; remove the line to run the case again"):
        Store(path, "one")


def test_the_version_changes_with_the_code_that_determines_results_only(tmp_path: Path) -> None:
    packages = {f"armident.{name}": tmp_path / name for name in ("configs", "identify", "virtual_robot")}
    packages["tests.evaluation"] = tmp_path / "evaluation"

    def write(name: str, content: str) -> str:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
        return code_version(packages)

    first = write("identify/search.py", "a = 1")
    for name in (
        "identify/report/page.py",
        "evaluation/suite.yaml",
        "evaluation/tables.py",
        "identify/notes.md",
    ):
        assert write(name, "b = 2") == first, name
    versions = [
        write(name, "b = 2")
        for name in (
            "identify/search.py",
            "evaluation/tasks.py",
            "configs/robots/emps.yaml",
            "virtual_robot/noise.py",
        )
    ]
    assert len({first, *versions}) == 5


def test_the_version_is_that_of_the_imported_packages() -> None:
    assert code_version() == code_version()
    assert code_version() != code_version({})


def test_an_incomplete_last_line_is_removed_and_any_other_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    whole = json.dumps({"key": "a", "error": "it broke", "code": "one"})
    path.write_text(f'{whole}\n{{"key": "b", "docu', encoding="utf-8")
    store = Store(path, "one")
    store.add(CaseResult(key="c", error="too"))
    assert [json.loads(line)["key"] for line in path.read_text(encoding="utf-8").splitlines()] == ["a", "c"]
    path.write_text(f"nonsense\n{whole}\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"results\.jsonl:1: not JSON"):
        Store(path, "one")
