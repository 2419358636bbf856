"""Runs of the suite: simulated effects are found, and healthy arms have no findings."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from armident.processes import CommandProcess, start_command
from tests.evaluation.run import REPORT, RESULTS, SUMMARY
from tests.tools.command_line import NAME, laboratory

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def suite(*words: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "tests.evaluation", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def in_process(*words: str) -> Result:
    """Run the command without a process of its own, for calls that start no case."""
    return CliRunner().invoke(laboratory("tests.evaluation.command:suite"), [NAME, *words], env={"COLUMNS": "200"})


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Three cases on the virtual EMPS: a spring, a case that fails, and a healthy arm."""
    spring = {
        "effect": "joint_spring",
        "parameters": {"stiffness": "s * fc"},
        "truth": {"ks": "stiffness"},
        "levels": ["obvious"],
        "strength": {"emps": {"joint_1": 0.3}},
    }
    content = {
        "schema": "armident/suite/1",
        "runs": 1,
        "multiples": {"detectable": 1.0, "typical": 1.75, "obvious": 3.2},
        "robots": {"emps": {"config": "emps.yaml", "trajectories": ["trajectories/emps_1.yaml"]}},
        "clean": {"emps": 1},
        # a torque offset has no stiffness
        "effects": [spring, {**spring, "effect": "torque_offset"}],
    }
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Child processes react to SIGINT, also where the tests were started in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_run_ends_with_all_its_processes(small: Path, tmp_path: Path) -> None:
    interrupt(("--suite", str(small), "--out", str(tmp_path / "out"), "--jobs", "1"), tmp_path / "out")


@pytest.mark.nightly
@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_run_continues_and_reports_findings_and_failures(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--suite", str(small), "--out", str(out), "--jobs", "2")
    stopped = in_process(*words, "--minutes", "0")
    assert stopped.exit_code == 0, stopped.stderr
    assert "0 of 3 cases" in stopped.stdout
    interrupt(words, out)

    done = suite(*words)
    assert done.returncode == 1
    assert "1 of 3 cases failed" in done.stderr
    assert "torque_offset takes torque" in done.stderr
    result = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
    rows = {row["label"]: row for row in result["effects"]}
    assert rows["torque_offset"]["failed"] == 1
    spring = rows["joint_spring"]
    assert (spring["n"], spring["first"], spring["failed"]) == (1, 1.0, 0)
    assert spring["closed"] > 0.9
    assert spring["within"] == 1.0
    assert result["healthy"][0]["alarms"] == 0
    assert re.search(r"\| joint_spring +\| obvious +\| 1 +\|", (out / REPORT).read_text(encoding="utf-8"))

    # Without the case that fails nothing is left to run.
    lines = (out / RESULTS).read_text(encoding="utf-8")
    some = (*words, "--only", "joint_spring,clean")
    again = in_process(*some, "--json")
    assert again.exit_code == 0, again.stderr
    assert "2 cases, 2 done before" in again.stderr
    result = json.loads(again.stdout)
    assert (result["run"], result["not_run"]) == (2, 0)
    assert result["effects"] == [spring]
    assert result == json.loads((out / SUMMARY).read_text(encoding="utf-8"))
    assert "2 of 2 cases" in (out / REPORT).read_text(encoding="utf-8")
    assert (out / RESULTS).read_text(encoding="utf-8") == lines


def interrupt(words: tuple[str, ...], out: Path) -> None:
    """Start a run, send Ctrl-C when its first case has begun, and check that all of its processes end."""
    start = partial(start_command, module="tests.evaluation", own_session=True)
    with CommandProcess(words, start=start) as process:
        log = out / "logs" / "plant.0.log"
        until = time.monotonic() + 120
        while not log.exists() and process.process.poll() is None and time.monotonic() < until:
            time.sleep(0.1)
        children = descendants(getattr(process.process, "pid", 0))
        process.send_signal(signal.SIGINT)
        begin = time.monotonic()
        process.process.wait(60)
    assert time.monotonic() - begin < 30
    assert process.exit_code == 130, process.errors()
    assert "Traceback" not in process.errors()
    assert children
    # The resource tracker of multiprocessing ends shortly after its parent.
    until = time.monotonic() + 20
    while (left := [child for child in children if Path(f"/proc/{child}").exists()]) and time.monotonic() < until:
        time.sleep(0.05)
    assert left == []
    # A case may have ended before the signal; all of them have not, or the exit code would be another.
    done = (out / RESULTS).read_text().splitlines() if (out / RESULTS).exists() else []
    assert len(done) < 3


def descendants(ancestor: int) -> list[int]:
    """Numbers of all child processes of a process, and of theirs."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    children = [pid for pid, parent in parents.items() if parent == ancestor]
    return children + [pid for child in children for pid in descendants(child)]


LEAST = {
    "effect and joint correct": 0.70,
    "effect and joint correct, first or second choice": 0.70,
    "healthy arms with verdict no_gap": 1.0,
    "cases with at least 90% of the gap closed": 0.60,
    "parameters within three standard deviations": 0.70,
}
"""Limits for the quick subset (one run per effect): two binomial standard deviations below its results or more."""


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Summary of the quick subset."""
    out = tmp_path_factory.mktemp("quick")
    done = suite("--quick", "--out", str(out))
    assert done.returncode == 0, done.stderr
    result = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
    assert f"{result['run']} of {result['run']} cases" in done.stdout
    return result


@pytest.mark.nightly
def test_most_of_the_quick_subset_is_named_and_no_healthy_arm_is_blamed(quick: Any) -> None:
    assert quick["not_run"] == 0
    reached = {aim["what"]: aim["value"] for aim in quick["aims"]}
    assert {what: reached[what] for what, least in LEAST.items() if reached[what] < least} == {}
    assert sum(row["n"] for row in quick["healthy"] if row["label"].endswith(", all")) >= 12


@pytest.mark.nightly
@pytest.mark.xfail(strict=True, reason="closes 72 %: small effects close little of their gap beside the noise")
def test_the_gap_of_the_quick_subset_is_closed(quick: Any) -> None:
    closed = "mean closed share of the injected gap where the effect is correct"
    assert next(aim["value"] for aim in quick["aims"] if aim["what"] == closed) >= 0.85
