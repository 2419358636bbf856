"""Recordings of different sampling rates: refused with the command that resamples them, and the command works."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import armident
from armident.configs import DataError
from armident.configs.errors import FOUND
from armident.daq.cli import application
from armident.daq.recording import write_recording
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document
from armident.identify.signals.experiments import Experiment, check_one_rate
from tests.fixtures.arms import FAST, recording


def run(*words: str) -> Result:
    """Result of a command."""
    return CliRunner().invoke(application(words), list(words))


def of_period(dt: float, source: str = "") -> Experiment:
    """Experiment of one axis at rest."""
    return Experiment(np.zeros((10, 1)), np.zeros((10, 1)), None, dt, source=source)


def test_rounding_of_a_rate_is_no_difference() -> None:
    check_one_rate([of_period(1e-3), of_period(1e-3 * (1 + 1e-8))])


def test_the_line_has_a_command_for_every_file_above_the_lowest_rate() -> None:
    experiments = [of_period(2.5e-4, "a b.mcap"), of_period(1e-3, "c.mcap"), of_period(5e-4, "d.mcap")]
    with pytest.raises(DataError) as raised:
        check_one_rate(experiments)
    assert str(raised.value) == (
        "the recordings have different sampling rates (a b.mcap 4000 Hz, c.mcap 1000 Hz, d.mcap 2000 Hz): "
        "resample to the lowest: armident import 'a b.mcap' --rate 1000 --out 'a b_1000Hz.mcap'; "
        "armident import d.mcap --rate 1000 --out d_1000Hz.mcap"
    )


def test_experiments_without_a_file_are_refused_with_the_rate() -> None:
    with pytest.raises(DataError, match="resample them to 1000 Hz"):
        check_one_rate([of_period(1e-3), of_period(5e-4)])


@pytest.mark.nightly
def test_a_resampled_recording_has_no_finding_beside_a_slow_one(tmp_path: Path) -> None:
    slow, fast, resampled = (tmp_path / f"{name}.mcap" for name in ("slow", "fast", "resampled"))
    write_recording(recording("emps", "emps_1", 1, period=2 * FAST), slow)
    write_recording(recording("emps", "emps_1", 2, period=FAST), fast)
    assert run("import", str(fast), "--rate", "500", "--out", str(resampled)).exit_code == 0
    found = run("diagnose", str(slow), str(resampled), "--out", str(tmp_path))
    # Exit code 4: a spectral line at 100 Hz, the rate of the set points of the slow recording, may stay unexplained.
    assert found.exit_code in (0, FOUND), found.stderr
    assert load_document(tmp_path / "diagnosis.json", DiagnosisDocument).findings == []


@pytest.mark.slow
def test_the_command_of_the_line_makes_the_recordings_fit(tmp_path: Path) -> None:
    slow, fast = tmp_path / "slow.mcap", tmp_path / "fast.mcap"
    write_recording(recording("emps", "emps_1", 1, period=2 * FAST), slow)
    write_recording(recording("emps", "emps_1", 2, period=FAST), fast)
    out = ("--out", str(tmp_path / "out"))
    for words in (("diagnose", str(slow), str(fast), *out), ("check", str(slow), str(fast))):
        refused = run(*words)
        assert refused.exit_code == DataError.exit_code
        command = refused.stderr.split("resample to the lowest: ")[1].strip()
        assert command == f"armident import {fast} --rate 500 --out {tmp_path / 'fast_500Hz.mcap'}"
    with pytest.raises(DataError, match="resample to the lowest"):
        armident.diagnose(slow, validate=fast)
    with pytest.raises(DataError, match="resample to the lowest"):
        armident.identify([slow, fast])
    assert run(*shlex.split(command)[1:]).exit_code == 0
    resampled = tmp_path / "fast_500Hz.mcap"
    assert run("check", str(slow), str(resampled)).exit_code == 0
    # The resampled recording identifies the same model. A recording at 500 Hz has 0.7 % more viscous and 1.6 % less dry
    # friction than one at 1 kHz, resampled or not.
    before, after = (armident.identify(file, method="idim-iv") for file in (fast, resampled))
    np.testing.assert_allclose(after.theta, before.theta, rtol=0.02)
