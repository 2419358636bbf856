"""Parameters and noise of an earlier identification in the design of the next experiment."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from armident.configs import DataError, load_robot, load_trajectory
from armident.identify.cli import trajectory as trajectory_command
from armident.identify.documents.files import to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.excitation.previous_estimate import _deviation_below, physical_estimate, previous_estimate
from armident.identify.identification.equations import LS_CUTOFF
from tests.fixtures.arms import identified

pytestmark = pytest.mark.slow


def document() -> IdentificationDocument:
    return identified("tx40", "tx40_excitation", 1, checked=False).document


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


def changed(name: str, value: float) -> IdentificationDocument:
    """The identification with another value of one parameter, and without a verdict, as of former versions."""
    parameters = [p.model_copy(update={"value": value}) if p.name == name else p for p in document().parameters]
    return document().model_copy(update={"parameters": parameters, "verdict": None, "reasons": []})


def test_parameters_that_no_arm_has_are_refused_with_the_reason_and_the_next_step() -> None:
    robot = load_robot("tx40")
    assert physical_estimate(document(), robot, "tx40.json").theta.shape == (61,)
    with pytest.raises(DataError, match=r"no arm has these parameters: negative fv2 = -5\.0+ ± .*Next: .*--physical"):
        physical_estimate(changed("fv2", -5.0), robot, "tx40.json")
    with pytest.raises(DataError, match=r"the mass matrix is not positive definite.*Next: "):
        physical_estimate(changed("zz1r", -1.0), robot, "tx40.json")


def test_the_nearest_physical_parameters_of_a_document_are_taken() -> None:
    base = [{"name": p.name, "value": p.value, "shift_std": 0.0} for p in document().parameters]
    odd = changed("fv2", -5.0).model_copy(update={"physical": {"base": base}})
    assert physical_estimate(odd, load_robot("tx40"), "tx40.json").theta.min() > -5.0


def test_an_unusable_identification_is_refused() -> None:
    unusable = document().model_copy(update={"verdict": "unusable"})
    with pytest.raises(DataError, match=r"its verdict is unusable .*Next: "):
        physical_estimate(unusable, load_robot("tx40"), "tx40.json")


def test_the_command_predicts_the_precision(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = tmp_path / "identification.json"
    write_atomically(known, to_json(document()))
    out = tmp_path / "excitation.yaml"
    trajectory_command(Path("tx40.yaml"), out, 5.0, 0, known, 5)
    printed = capsys.readouterr().out
    assert "predicted precision" in printed
    assert "condition number" in printed
    load_trajectory(str(out)).check(load_robot("tx40"))
