"""Lack of fit: uniform p-values of healthy arms, dependences with their curves, spectral lines."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import lfilter

from armident.configs import load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.free_functions import free_functions
from armident.identify.diagnosis.lack_of_fit import LackOfFit, limited
from armident.identify.diagnosis.noise_beyond import noise_beyond
from armident.identify.diagnosis.regression import IvFit, fit_model
from armident.identify.diagnosis.spectral_lines import strongest_line
from armident.identify.diagnosis.stretch import MotionStretch
from armident.identify.diagnosis.study import Study, build_study
from armident.identify.diagnosis.variables import VARIABLES, hint_of
from armident.identify.effects.free_shapes import hats
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.regression.equations import applied
from tests.fixtures.arms import FAST, recording

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]

DEVIATIONS = Criteria.robust_deviations
BUMP = 5.0
"""Height of the hidden bump, N m; the noise of joint 2 in the band of the comparison is 3 N m."""


def coloured(rng: np.random.Generator, samples: int) -> Array:
    noise: Array = lfilter([1.0], [1.0, -1.2, 0.5], rng.standard_normal(samples))
    return noise


def studied(name: str, motion: str, *effects: HiddenEffect, seed: int, repeats: int = 1) -> Study:
    robot = load_robot(name)
    data = recording(name, motion, seed, *effects, repeats=repeats, period=FAST, setpoint_every=1)
    return build_study(experiments_from_recording(data, robot)[0], [], robot)


@cache
def emps() -> tuple[Study, IvFit]:
    study = studied("emps", "emps_excitation", seed=1)
    return study, fit_model(study)


def of_coloured_noise(seed: int) -> LackOfFit:
    """Tests of an arm whose torques are those of its model and coloured noise."""
    study, found = emps()
    rng = np.random.default_rng(seed)
    size = float(np.sqrt(np.mean(np.concatenate(found.left) ** 2)))

    def noisy(part: str) -> tuple[MotionStretch, ...]:
        rows = found.equations.train if part == "train" else found.equations.held
        out = []
        for stretch, own in zip(getattr(study, part), rows, strict=True):
            y = own.y
            noise = np.stack([coloured(rng, y.shape[0]) for _ in range(y.shape[1])], axis=1)
            out.append(replace(stretch, y=np.where(y == 0, 0.0, applied(own.x, found.theta) + 0.4 * size * noise)))
        return tuple(out)

    return LackOfFit(fit_model(replace(study, train=noisy("train"), held=noisy("held"))))


@cache
def healthy_arms(arms: int) -> tuple[LackOfFit, ...]:
    return tuple(of_coloured_noise(seed) for seed in range(arms))


ARMS = pytest.mark.parametrize("arms", [16, pytest.param(40, marks=pytest.mark.nightly)])


@ARMS
def test_p_values_of_healthy_arms_are_uniform(arms: int) -> None:
    every = [[(p.p_train, p.p_held, p.p_value) for p in own.projections] for own in healthy_arms(arms)]
    sizes = {len(own) for own in every}
    assert len(sizes) == 1
    p = np.array(every)
    # The tests of one arm are correlated: each is uniform over the arms.
    for k in range(p.shape[1]):
        for kind in range(3):
            assert np.sum(p[:, k, kind] < 0.05) <= stats.binom.ppf(1 - 1e-4, arms, 0.05)
            assert stats.kstest(p[:, k, kind], "uniform").pvalue > 1e-4
    known = 0.03 * np.sqrt(40 / arms)
    assert 0.05 - known < np.mean(p[:, :, 2] < 0.05) < 0.05 + known


@ARMS
def test_healthy_arms_have_no_dependence(arms: int) -> None:
    assert sum(bool(own.unexplained) for own in healthy_arms(arms)) <= 1


@cache
def strange() -> LackOfFit:
    """Tests of an arm with two effects outside the catalogue."""
    bump = HiddenEffect(effect="torque_bump", joint="joint_2", parameters={"torque": BUMP, "position": 0.3})
    ripple = HiddenEffect(effect="mains_ripple", joint="joint_3", parameters={"amplitude": 1.0, "frequency": 100.0})
    return LackOfFit(fit_model(studied("tx40", "tx40_excitation", bump, ripple, seed=40, repeats=3)))


def test_a_bump_has_its_place_and_its_height() -> None:
    (bump,) = [d for d in strange().dependences if d.joint == "joint_2" and d.varies_with == "position"]
    assert bump.unit == "rad"
    assert bump.p_value < 1e-6
    assert bump.share > 0.02
    peak = int(np.argmax(bump.curve.value))
    # The knots over 3.6 rad are 0.16 rad apart, and the bump is 0.09 rad wide.
    assert bump.curve.x[peak] == pytest.approx(0.3, abs=0.16)
    height = bump.curve.value[peak] - float(np.median(bump.curve.value))
    # Smoothing and wide knots make a narrow bump lower than it is.
    assert 0.35 * BUMP < height < 1.2 * BUMP
    assert height > 2 * bump.curve.band[peak]
    assert f"most at {bump.curve.x[peak]:.3g} rad" in bump.hint


def test_a_bump_below_the_limit_of_the_user_is_too_small_to_matter() -> None:
    large = strange()
    assert not {d.joint for d in large.unexplained} & {d.joint for d, _ in large.immaterial}
    study = large.fit.study
    found = LackOfFit(large.fit.of_study(replace(study, criteria=replace(study.criteria, material_pct=50.0))))
    assert found.unexplained == ()
    small = {d.joint: (d.varies_with, fall) for d, fall in found.immaterial}
    assert small["joint_2"][0] == "position"
    assert 0.2 < small["joint_2"][1] < 50.0


def test_times_about_reversals_are_no_evidence_of_a_dependence() -> None:
    """Friction at speeds under 2 mm/s, where dry friction reverses within 0.6 and 20 mm/s."""
    study, _ = emps()

    def braked(stretches: tuple[MotionStretch, ...]) -> tuple[MotionStretch, ...]:
        out = []
        for stretch in stretches:
            qd = stretch.measured.qd
            torque = 20.0 * np.tanh(qd / 1e-4) * np.exp(-((qd / 2e-3) ** 2))
            out.append(replace(stretch, y=stretch.y + np.where(stretch.y == 0, 0.0, study.decimation(torque))))
        return tuple(out)

    sharp = LackOfFit(fit_model(replace(study, train=braked(study.train), held=braked(study.held))))
    criteria = replace(study.criteria, reversal=100.0)
    gradual = LackOfFit(sharp.fit.of_study(replace(sharp.fit.study, criteria=criteria)))
    assert [d.varies_with for d in sharp.unexplained] == ["velocity"]
    assert gradual.unexplained == ()
    assert {d.varies_with for d in gradual.dependences} == {d.varies_with for d in sharp.dependences}


def test_a_mains_line_beyond_the_band_of_the_comparison_is_found() -> None:
    (line,) = [d for d in strange().dependences if d.kind == "frequency"]
    assert line.joint == "joint_3"
    assert line.curve.x[int(np.argmax(line.curve.value))] == pytest.approx(100.0, abs=0.1)
    # The mean of neighbouring samples, which belongs to the position between them, keeps cos(pi f dt) of a line.
    assert line.curve.value.max() == pytest.approx(np.cos(np.pi * 100.0 * 1e-3), rel=0.1)


def test_each_unexplained_dependence_is_listed_once() -> None:
    assert {(d.joint, d.varies_with) for d in strange().unexplained} == {
        ("joint_2", "position"),
        ("joint_3", "frequency"),
    }


def test_every_set_of_functions_has_its_own_key_and_a_hint() -> None:
    study = studied("tx40", "tx40_excitation", seed=1)
    motions = [study.motion(s, "simulated", fit_model(study).theta) for s in study.train]
    every = list(free_functions(study, motions, 0))
    assert len({(f.kind, f.other, f.knots) for f in every}) == len(every)
    tests = {"frequency", "motion", "unrecorded signal", "bursts", "recording"}
    assert {f.kind for f in every} | tests == set(VARIABLES)
    text = hint_of("torque of another joint", "joint_3", "joint_2", "1 N m")
    assert text.startswith("The torque of joint_3 follows that of joint_2: look for")


def test_hat_functions_add_up_to_one_and_interpolate() -> None:
    knots = (-1.0, 0.0, 0.5, 2.0)
    x = np.linspace(-3, 3, 50)
    basis = hats(x, knots)
    assert np.allclose(basis.sum(axis=1), 1.0)
    assert np.allclose(basis @ np.array(knots), np.clip(x, -1.0, 2.0))


def test_the_noise_model_has_the_power_that_the_functions_take_away() -> None:
    """Half of the cosines of the lowest eighth of the frequencies."""
    samples = 1000
    slow = np.cos(np.pi * np.outer(np.arange(samples) + 0.5, np.arange(0, 120, 2)) / samples)
    at_zero = []
    for seed in range(10):
        noise = noise_beyond([coloured(np.random.default_rng(seed), samples)], [slow])
        at_zero.append(noise.variance / (1.0 + noise.coefficients.sum()) ** 2)
    assert np.median(at_zero) == pytest.approx(1.0 / 0.3**2, rel=0.35)


def test_coloured_noise_seldom_has_a_line() -> None:
    rng = np.random.default_rng(1)
    p = []
    for _ in range(200):
        line = strongest_line([coloured(rng, 9000)], [coloured(rng, 5000)], 1e-3, 10.0)
        assert line is not None
        p.append((line.p_train, line.p_held))
    train, held = np.array(p).T
    # 5 % of 200, and three standard deviations of a binomial count more.
    assert np.sum(train < 0.05) <= 10 + 3 * np.sqrt(10)
    assert 1 <= np.sum(held < 0.05) <= 10 + 3 * np.sqrt(10)


def test_a_line_in_coloured_noise_is_found_with_its_power() -> None:
    rng = np.random.default_rng(2)
    t = 1e-3 * np.arange(9000)
    train = coloured(rng, 9000) + np.sin(2 * np.pi * 61.3 * t + 0.4)
    held = coloured(rng, 9000) + np.sin(2 * np.pi * 61.3 * t + 2.0)
    line = strongest_line([train], [held], 1e-3, 10.0)
    assert line is not None
    assert line.frequency == pytest.approx(61.3, abs=0.5 / 9)
    assert line.p_value < 1e-6
    assert line.share == pytest.approx(0.5 / np.mean(held**2), rel=0.3)
    assert strongest_line([train[:200]], [held], 1e-3, 10.0) is None


def test_a_few_large_residuals_are_limited_and_a_large_residual_is_not() -> None:
    rng = np.random.default_rng(0)
    residual = np.concatenate([rng.standard_normal(1000), 50.0 * rng.standard_normal(1000), np.zeros(10)])
    residual[[3, 900]] = 200.0, -300.0
    joints = [slice(0, 1000), slice(1000, 2000), slice(2000, 2010)]
    found = limited(residual, joints, DEVIATIONS)
    assert np.abs(found[:1000]).max() < 1.2 * DEVIATIONS
    assert found[3] == -found[900] > 0.0
    unusual = np.abs(residual) > DEVIATIONS * np.repeat([1.0, 50.0, 1.0], [1000, 1000, 10])
    assert np.mean(found[~unusual] == residual[~unusual]) > 0.999
    np.testing.assert_array_equal(found[2000:], 0.0)
