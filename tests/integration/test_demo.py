"""The demo: the real processes from beginning to end, and one clear line if one of them fails."""

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from armident.configs import ArmidentError
from armident.virtual_robot.demo import _running

LONGEST_S = 280


def test_a_process_that_fails_is_named_with_the_end_of_what_it_printed(tmp_path: Path) -> None:
    with (
        _running("capture", ["capture", "--config", "no_such_cell.yaml"], tmp_path) as capture,
        pytest.raises(
            ArmidentError, match=r"capture ended with exit code 2 \(log: .*capture\.log\).*no_such_cell\.yaml"
        ),
    ):
        capture.wait(60.0)


def test_a_process_that_ends_before_it_is_ready_is_an_error_at_once(tmp_path: Path) -> None:
    begin = time.monotonic()
    with (
        pytest.raises(ArmidentError, match="robot ended with exit code 2 before it printed 'ready'"),
        _running("robot", ["robot", "--config", "no_such_cell.yaml"], tmp_path, "ready"),
    ):
        pytest.fail("it was never ready")
    assert time.monotonic() - begin < 60.0


def test_processes_do_not_outlive_the_demo(tmp_path: Path) -> None:
    with _running("worker", ["worker", "--config", "tx40_replay.yaml"], tmp_path, "worker: ready") as worker:
        process = worker.process
        assert process.poll() is None
    assert process.poll() == 0


@pytest.mark.vcan
@pytest.mark.slow
@pytest.mark.timeout(LONGEST_S + 20)
def test_the_first_part_ends_with_a_table_the_next_commands_and_a_report_without_warnings(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "armident.daq.cli", "demo", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    last = done.stdout.strip().splitlines()[-1]
    report = Path(last.removeprefix("report: "))
    assert "identified dynamic model" in report.read_text(encoding="utf-8")
    distances = [float(v) for v in re.findall(r"(-?\d+\.\d) std$", done.stdout, re.MULTILINE)]
    assert len(distances) >= 20
    # Of some 25 parameters none may be further from the plant's own than five of its standard deviations.
    assert max(abs(d) for d in distances) < 5.0
    assert "armident identify my_robot.mcap" in done.stdout
    noise = re.compile("warning|fontconfig|matplotlib", re.IGNORECASE)
    assert [line for line in done.stderr.splitlines() if noise.search(line)] == []
