"""A short run of ``python -m tests.faults.hour``, without its check of memory."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


@pytest.mark.timeout(280)
def test_a_minute_of_six_drives_is_recorded_without_loss() -> None:
    command = [sys.executable, "-m", "tests.faults.hour", "--hours", "0.02"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=270)
    assert "rows 360000, in gaps 0, not written 0" in done.stdout, done.stderr
    assert "settled_mb" in done.stdout
