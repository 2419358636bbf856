"""Some rounds of ``python -m tests.faults.bus`` and ``python -m tests.faults.kill``."""

import subprocess
import sys

import pytest

from tests.faults.plan import EVERY_FAULT, FAULTS

pytestmark = [pytest.mark.vcan, pytest.mark.nightly]


def run(*arguments: str) -> str:
    """Return the output of a command that must succeed."""
    done = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, timeout=270)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_sync_is_received_or_in_a_gap_with_any_fault() -> None:
    assert sorted(name for faults, *_ in EVERY_FAULT for name in faults) == sorted(FAULTS)
    assert "0 with violations" in run("tests.faults.bus", "--every-fault", "--jobs", "1")


@pytest.mark.parametrize("rounds", [20])
def test_a_kill_costs_a_tenth_of_a_second_at_most_and_every_file_is_recovered(rounds: int) -> None:
    assert "0 with violations" in run("tests.faults.kill", "--rounds", str(rounds))
