"""A short run of ``python -m tests.faults.hour``, without its check of memory."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("hours", "rows"), [(0.001, 18_000), pytest.param(0.02, 360_000, marks=pytest.mark.nightly)])
def test_many_seconds_of_six_drives_are_recorded_without_loss(hours: float, rows: int) -> None:
    command = [sys.executable, "-m", "tests.faults.hour", "--hours", str(hours)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=270)
    assert f"rows {rows}, in gaps 0, not written 0" in done.stdout, done.stderr
    assert "settled_mb" in done.stdout
