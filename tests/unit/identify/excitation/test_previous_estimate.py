"""Parameters and noise of an earlier identification in the design of the next experiment."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from armident.configs import DataError, load_robot, load_trajectory
from armident.identify.cli import trajectory as trajectory_command
from armident.identify.document import IdentificationDocument, to_json, write_atomically
from armident.identify.excitation.previous_estimate import _deviation_below, previous_estimate
from armident.identify.identification.equations import LS_CUTOFF
from tests.fixtures.arms import identified

pytestmark = pytest.mark.slow


def document() -> IdentificationDocument:
    return identified("tx40", "tx40_excitation", 1).document


def test_noise_below_a_frequency_is_the_filtered_noise() -> None:
    rng = np.random.default_rng(3)
    noise = lfilter([1.0], [1.0, -0.9], rng.standard_normal(400_000))
    spectrum = np.abs(np.fft.rfft(noise)) ** 2 / noise.size**2 * 2
    frequency = np.fft.rfftfreq(noise.size, 1 / 100.0)
    for cutoff in (5.0, 20.0, 50.0):
        left = float(np.sqrt(np.sum(spectrum[frequency <= cutoff])))
        assert _deviation_below(cutoff, 100.0, 1.0, [-0.9]) == pytest.approx(left, rel=0.02)


def test_parameters_and_noise_of_an_identification_are_taken_over() -> None:
    robot = load_robot("tx40")
    prior = previous_estimate(document(), robot, "tx40.json")
    assert prior.theta.shape == (61,)
    assert prior.theta[0] == document().parameters[0].value
    # Table 6.3: variances of the noise that is left after the usual decimation.
    expected = np.sqrt([1.537, 1.793, 0.9120, 0.2199, 0.6207, 0.2523])
    assert robot.bandwidth_hz is not None
    assert LS_CUTOFF * robot.bandwidth_hz == pytest.approx(20.0)
    assert np.all(np.abs(prior.noise / expected - 1) < 0.3)


def test_another_robot_or_model_is_refused_by_name() -> None:
    with pytest.raises(DataError, match=r"tx40\.json: the identification of robot 'tx40', the configuration is 'emps'"):
        previous_estimate(document(), load_robot("emps"), "tx40.json")
    other = load_robot("tx40").model_copy(update={"couplings": ()})
    with pytest.raises(DataError, match="other base parameters than the configuration of tx40: fcm6, fvm6, iam6"):
        previous_estimate(document(), other, "tx40.json")
    positions = document().model_copy(update={"noise_model": document().noise_model | {"of": "joint position"}})
    with pytest.raises(DataError, match="noise_model: expected one model of joint torques for each of 6 joints"):
        previous_estimate(positions, load_robot("tx40"), "tx40.json")


def test_the_command_predicts_the_precision(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = tmp_path / "identification.json"
    write_atomically(known, to_json(document()))
    out = tmp_path / "excitation.yaml"
    trajectory_command(Path("tx40.yaml"), out, 5.0, 0, known, 20)
    printed = capsys.readouterr().out
    assert "predicted precision" in printed
    assert "condition number" in printed
    load_trajectory(str(out)).check(load_robot("tx40"))
