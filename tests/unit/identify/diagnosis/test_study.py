"""Data of a diagnosis: torques that are corrected or shifted, with the same motion."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.model_state import ModelState, fitted
from armident.identify.diagnosis.precision import standard_deviations
from armident.identify.diagnosis.selection import StepwiseSelection
from armident.identify.diagnosis.study import Study, _aligned, build_study
from armident.identify.effects.drive import Correction
from armident.identify.effects.recording_corrections import corrected_experiments
from armident.identify.effects.registry import known
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups

Array = NDArray[np.float64]

LATE = 0.5
DT = 4e-3


@pytest.fixture(scope="module")
def experiments() -> list[Experiment]:
    return setups.record(setups.random_arm(3, 4), 0, noise=0.003, dt=DT)


@pytest.fixture(scope="module")
def study(experiments: list[Experiment]) -> Study:
    return build_study(experiments, [], setups.random_arm(3, 4))


def reported(experiments: list[Experiment], joint: int, gain_error: float) -> list[Experiment]:
    """Experiments in which one drive reports torques with a wrong gain."""
    gains = np.ones(experiments[0].tau.shape[1])
    gains[joint] += gain_error
    return [replace(e, tau=e.tau * gains) for e in experiments]


def test_a_torque_correction_gives_the_equations_of_corrected_recordings(experiments: list[Experiment]) -> None:
    robot = setups.random_arm(3, 4)
    entry = Effect(effect="drive_gain_error", joint=robot.joints[1].name, parameters={"gain_error": 0.25})
    wrong = build_study(reported(experiments, 1, 0.25), [], robot)
    corrected = wrong.of_robot(robot.model_copy(update={"effects": (entry,)}))
    right = build_study(experiments, [], robot)
    for found, expected in zip((*corrected.train, *corrected.held), (*right.train, *right.held), strict=True):
        np.testing.assert_allclose(found.y, expected.y, atol=1e-9 * np.abs(expected.y).max())
        np.testing.assert_allclose(found.torque, expected.torque, atol=1e-9 * np.abs(expected.torque).max())
    # White noise of the corrected joint is 1 / 1.25 of that of the recorded one.
    np.testing.assert_allclose(corrected.volume, [0.0, -np.log(1.25), 0.0, 0.0], atol=0.01)


def test_the_gain_of_a_drive_that_reports_too_much_is_corrected(experiments: list[Experiment]) -> None:
    robot = setups.random_arm(3, 4)
    entry = Effect(effect="drive_gain_error", joint=robot.joints[2].name, parameters={"gain_error": -0.3})
    found = corrected_experiments(reported(experiments, 2, -0.3), robot.model_copy(update={"effects": (entry,)}))
    for own, true in zip(found, experiments, strict=True):
        np.testing.assert_allclose(own.tau, true.tau, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "value", "step"),
    [
        ("drive_gain_error", 0.25, 1e-3),
        ("drive_gain_saturation", 0.3, 1e-3),
        ("time_delay", 2 * DT, DT),
        ("actuator_bandwidth", 0.5 * DT, 0.01 * DT),
    ],
)
def test_the_slope_of_a_correction_compares_a_change_of_its_value_with_a_further_correction(
    name: str, value: float, step: float
) -> None:
    effect = known(name)
    assert isinstance(effect, Correction)
    recorded = 5.0 * np.sin(2 * np.pi * np.arange(500) / 200.0)

    def true(torque: Array, value: float) -> Array:
        return effect.true_torque(torque, value, DT, 8.0)

    before = true(recorded, value)
    changed, further = true(recorded, value + step) - before, true(before, step) - before
    assert effect.relative_slope(value) == pytest.approx(changed @ further / (further @ further), rel=0.02)


def test_the_standard_deviation_of_a_correction_is_that_of_its_likelihood(experiments: list[Experiment]) -> None:
    robot = setups.random_arm(3, 4)
    wrong = build_study(reported(experiments, 1, 0.25), [], robot)

    def state_at(value: float) -> ModelState:
        entry = Effect(effect="drive_gain_error", joint=robot.joints[1].name, parameters={"gain_error": value})
        exact = robot.model_copy(update={"effects": (entry,)})
        return fitted(wrong.of_robot(exact), exact, None)

    best = state_at(0.25)
    std = standard_deviations(best)[0]["gain_error"]
    noise = best.own_noise
    lower, upper = (state_at(0.25 + k * std).score.log_likelihood_under(noise) for k in (-6.0, 6.0))
    curvature = 2.0 * best.score.log_likelihood_under(noise) - lower - upper
    # The serial correlation of the residual (Newey, West) and the noise models of each fit differ from the likelihood.
    assert 0.5 < 6.0 / np.sqrt(curvature) < 2.0


def test_torques_are_interpolated_without_loss_of_high_frequencies() -> None:
    t = DT * np.arange(2000)
    for w in (2 * np.pi, 2 * np.pi * 0.35 / DT):
        wave = np.sin(w * t)
        one = Experiment(t[:, None].astype(np.float64), wave[:, None].astype(np.float64), None, DT)
        # A held torque belongs half a sample later: at a position it is that of half a sample before.
        expected = np.sin(w * (t - 0.5 * DT))
        np.testing.assert_allclose(_aligned(one)[50:-50, 0], expected[50:-50], atol=2e-3)
        np.testing.assert_allclose(_aligned(replace(one, torque_shift=LATE))[50:-50, 0], wave[50:-50], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["followed", "nominal"])
def test_the_base_fit_decides_a_shift_that_the_check_leaves_open(loop: str, study: Study) -> None:
    sampled = replace(study, loop=loop).with_torque_shift(-LATE)
    # Relative to these the torques of the study are half a sample late.
    states = {
        shifts: StepwiseSelection(sampled, shifts=shifts).start() for shifts in ((), (-LATE, 0.0), (-LATE, -2 * LATE))
    }
    shifted = states[-LATE, 0.0]
    assert shifted.study.sources[0][0].torque_shift == 0.0
    assert np.all(shifted.score.rms < states[()].score.rms)
    assert any("late by 0.00 samples" in line for line in shifted.study.warnings)
    for shifts in ((), (-LATE, -2 * LATE)):
        assert states[shifts].study.sources[0][0].torque_shift == -LATE
        assert not any("late by" in line for line in states[shifts].study.warnings)


def test_each_recording_has_noise_of_its_own_size(experiments: list[Experiment]) -> None:
    robot = setups.random_arm(3, 4)
    random = np.random.default_rng(0)
    base = 0.05 * experiments[0].tau.std(axis=0)
    noisy = [
        replace(experiments[0], tau=experiments[0].tau + size * base * random.standard_normal(experiments[0].tau.shape))
        for size in (1.0, 3.0)
    ]
    first = StepwiseSelection(build_study(noisy, [], robot)).start()
    sizes = np.array([s.noise for s in first.study.train])
    np.testing.assert_allclose(sizes[1] / sizes[0], 3.0, rtol=0.15)
    np.testing.assert_allclose(np.prod(sizes, axis=0), 1.0, rtol=1e-6)
    for stretch in first.study.train:
        np.testing.assert_allclose(stretch.torques, stretch.y * stretch.noise)
    # One recording has no other one to be compared with.
    alone = StepwiseSelection(build_study(noisy[:1], [], robot)).start()
    assert all((s.noise == 1.0).all() for s in alone.study.train)
