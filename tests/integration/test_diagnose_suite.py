"""The suite at work: effects hidden in virtual arms are found by name, and healthy arms are left alone."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from armident.identify.evaluation.run import REPORT, RESULTS, SUMMARY, TABLE

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def diagnose_suite(*words: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "armident.daq.cli", "diagnose-suite", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Two cases on the virtual EMPS: a spring and a healthy arm."""
    content = {
        "schema": "armident/suite/1",
        "runs": 1,
        "multiples": {"detectable": 1.0, "typical": 1.75, "obvious": 3.2},
        "robots": {"emps": {"config": "emps.yaml", "trajectories": ["trajectories/emps_excitation.yaml"]}},
        "clean": {"emps": 1},
        "effects": [
            {
                "effect": "joint_spring",
                "parameters": {"stiffness": "s * fc"},
                "truth": {"ks": "stiffness"},
                "levels": ["obvious"],
                "strength": {"emps": {"joint_1": 0.3}},
            },
        ],
    }
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def test_a_spring_is_found_and_a_run_goes_on_where_it_was(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--suite", str(small), "--out", str(out), "--jobs", "2")
    stopped = diagnose_suite(*words, "--minutes", "0")
    assert stopped.returncode == 0, stopped.stderr
    assert "0 of 2 cases have been run" in stopped.stdout
    done = diagnose_suite(*words)
    assert done.returncode == 0, done.stderr
    result = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
    (row,) = result["effects"]
    assert (row["label"], row["n"], row["first"], row["failed"]) == ("joint_spring", 1, 1.0, 0)
    assert row["closed"] > 0.9
    assert row["within"] == 1.0
    assert (result["run"], result["not_run"]) == (2, 0)
    assert result["healthy"][0]["alarms"] == 0
    assert "joint_spring,obvious,1" in (out / TABLE).read_text(encoding="utf-8")
    told = (out / REPORT).read_text(encoding="utf-8")
    assert "2 of 2 cases" in told
    assert "| joint_spring | obvious | 1 |" in told
    lines = (out / RESULTS).read_text(encoding="utf-8")
    again = diagnose_suite(*words, "--json")
    assert "2 cases, 2 done before" in again.stderr
    assert json.loads(again.stdout) == result
    assert (out / RESULTS).read_text(encoding="utf-8") == lines


def test_a_case_that_fails_is_reported_and_not_swallowed(small: Path, tmp_path: Path) -> None:
    content = yaml.safe_load(small.read_text(encoding="utf-8"))
    content["effects"][0]["effect"] = "torque_offset"
    small.write_text(yaml.safe_dump(content), encoding="utf-8")
    out = tmp_path / "out"
    done = diagnose_suite("--suite", str(small), "--out", str(out), "--only", "torque_offset")
    assert done.returncode == 1
    assert "1 of 1 cases failed" in done.stderr
    assert "torque_offset takes torque" in done.stderr
    assert json.loads((out / SUMMARY).read_text(encoding="utf-8"))["effects"][0]["failed"] == 1


LEAST = {
    "name and place right": 0.70,
    "name and place right, or second": 0.70,
    "healthy arms called healthy": 1.0,
    "share of the injected gap closed, mean where named": 0.85,
    "cases with at least 90% of it closed": 0.60,
    "parameters within three standard deviations": 0.70,
}
"""Of the quick subset, one run of each effect: below what it comes to by two binomial deviations or more."""


@pytest.mark.proof
def test_most_of_the_quick_subset_is_named_and_no_healthy_arm_is_blamed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = diagnose_suite("--quick", "--out", str(tmp_path))
    with capsys.disabled():
        print(done.stdout, file=sys.__stderr__)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / SUMMARY).read_text(encoding="utf-8"))
    assert result["not_run"] == 0
    assert f"{result['run']} of {result['run']} cases have been run" in done.stdout
    reached = {aim["what"]: aim["value"] for aim in result["aims"]}
    assert {what: reached[what] for what, least in LEAST.items() if reached[what] < least} == {}
    assert sum(row["n"] for row in result["healthy"] if row["label"].endswith(", all")) >= 12
