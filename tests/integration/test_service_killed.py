"""Capture, workers, re-identification and history, killed at random moments: one result each, announced once."""

from pathlib import Path

import pytest

from tests.faults import service_vcan
from tests.faults.service import run_rounds


@pytest.mark.slow
@pytest.mark.parametrize(
    "rounds",
    [
        pytest.param(2, marks=pytest.mark.timeout(300)),
        pytest.param(200, marks=[pytest.mark.nightly, pytest.mark.timeout(3600)]),
    ],
)
def test_every_recording_has_one_result_that_was_announced_once(tmp_path: Path, rounds: int) -> None:
    folder = tmp_path / f"service_{rounds}"
    folder.mkdir()
    assert run_rounds(rounds, 3, folder) == []


@pytest.mark.slow
@pytest.mark.vcan
@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_every_recording_of_an_arm_has_one_result_that_was_announced_once(vcan_bus: str, tmp_path: Path) -> None:
    """The commands themselves, on a bus, with torn recordings and rotated files."""
    assert service_vcan.run_rounds(20, 11, tmp_path, vcan_bus) == []
