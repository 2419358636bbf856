"""Residual dependences: nonparametric curves, spectral lines, none in a correct model."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from armident.configs import load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.candidates import Workshop
from armident.identify.diagnosis.experiment import CONTAINS, recommended_experiment
from armident.identify.diagnosis.hints import HINTS, hint_of
from armident.identify.diagnosis.lines import strongest_line
from armident.identify.diagnosis.maps import hats, maps
from armident.identify.diagnosis.regression import Fit, fit
from armident.identify.diagnosis.study import build_study
from armident.identify.diagnosis.where import Disagreement, unexplained, where
from armident.identify.effects.registry import catalogue
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.thesis.recordings import measured_emps
from tests.fixtures.arms import FAST, recording

pytestmark = pytest.mark.slow

BUMP = 5.0
"""Height of the hidden bump, N m; the noise of joint 2 in the band of the comparison is 3 N m."""


def studied(*effects: HiddenEffect, seed: int) -> tuple[Fit, Workshop]:
    robot = load_robot("tx40")
    data = recording("tx40", "tx40_excitation", seed, *effects, repeats=3, period=FAST, setpoint_every=1)
    study = build_study(experiments_from_recording(data, robot)[0], [], robot)
    found = fit(study)
    return found, Workshop(study, found.theta)


@cache
def healthy() -> tuple[Fit, Workshop]:
    return studied(seed=7)


@cache
def strange() -> tuple[tuple[Disagreement, ...], tuple[Disagreement, ...]]:
    """Residual dependences of a plant with two effects outside the catalogue, and the unexplained ones."""
    bump = HiddenEffect(effect="torque_bump", joint="joint_2", parameters={"torque": BUMP, "position": 0.3})
    ripple = HiddenEffect(effect="mains_ripple", joint="joint_3", parameters={"amplitude": 1.0, "frequency": 100.0})
    data = studied(bump, ripple, seed=40)
    return tuple(where(*data)), tuple(unexplained(*data))


def test_a_bump_at_one_angle_is_seen_where_it_is_and_as_high_as_it_is() -> None:
    (bump,) = [d for d in strange()[0] if d.joint == "joint_2" and d.varies_with == "position"]
    assert bump.unit == "rad"
    assert bump.p_value < 1e-6
    assert bump.share > 0.02
    peak = int(np.argmax(bump.curve.value))
    # The knots over 3.6 rad are 0.16 rad apart, and the bump is 0.09 rad wide.
    assert bump.curve.x[peak] == pytest.approx(0.3, abs=0.16)
    ground = float(np.median(bump.curve.value))
    # Between the knots a narrow bump looks lower than it is.
    assert 0.5 * BUMP < bump.curve.value[peak] - ground < 1.2 * BUMP
    assert bump.curve.value[peak] - ground > 2 * bump.curve.band[peak]
    assert f"most at {bump.curve.x[peak]:.3g} rad" in bump.hint


def test_a_line_of_the_mains_is_seen_beyond_the_band_of_the_comparison() -> None:
    lines = [d for d in strange()[0] if d.kind == "frequency"]
    assert [d.joint for d in lines] == ["joint_3"]
    at = lines[0].curve.x[int(np.argmax(lines[0].curve.value))]
    assert at == pytest.approx(100.0, abs=0.1)
    # The mean of neighbouring samples, which belongs to the position between them, keeps cos(pi f dt) of a line.
    assert lines[0].curve.value.max() == pytest.approx(np.cos(np.pi * 100.0 * 1e-3), rel=0.1)


def test_what_is_unexplained_is_named_once() -> None:
    assert {(d.joint, d.varies_with) for d in strange()[1]} == {("joint_2", "position"), ("joint_3", "frequency")}


def test_an_arm_as_its_model_says_shows_nothing() -> None:
    data = healthy()
    assert where(*data) == []
    assert unexplained(*data) == []


def test_the_measured_emps_disagrees_in_its_friction_first(shared_data: Path) -> None:
    """Known missing effect: direction-dependent viscous friction (Janot, Gautier, Brunot 2019)."""
    measured = measured_emps(shared_data)
    if measured is None:
        pytest.skip("no DATA_EMPS.mat in the measured data")
    study = build_study([measured.experiment], [], measured.robot)
    found = fit(study)
    first = where(found, Workshop(study, found.theta))[0]
    assert first.varies_with == "velocity"
    assert first.share > 0.05
    assert first.hint.startswith("Friction of joint_1 does not follow the model")


def test_every_map_has_its_own_name_and_a_hint() -> None:
    found, workshop = healthy()
    every = list(maps(found.study, [workshop.motion(s, "simulated") for s in found.study.train]))
    assert len({m.key for m in every}) == len(every)
    assert {m.kind for m in every} | {"frequency", "motion", "transients"} == set(HINTS)
    text = hint_of("torque of another joint", "joint_3", "joint_2", "1 N m")
    assert text.startswith("The torque of joint_3 follows that of joint_2: look for")


def test_hat_functions_add_up_to_one_and_interpolate() -> None:
    knots = (-1.0, 0.0, 0.5, 2.0)
    x = np.linspace(-3, 3, 50)
    basis = hats(x, knots)
    assert np.allclose(basis.sum(axis=1), 1.0)
    assert np.allclose(basis @ np.array(knots), np.clip(x, -1.0, 2.0))


def coloured(rng: np.random.Generator, samples: int) -> NDArray[np.float64]:
    noise: NDArray[np.float64] = lfilter([1.0], [1.0, -1.2, 0.5], rng.standard_normal(samples))
    return noise


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
    amplitude = 1.0
    t = 1e-3 * np.arange(9000)
    train = coloured(rng, 9000) + amplitude * np.sin(2 * np.pi * 61.3 * t + 0.4)
    held = coloured(rng, 9000) + amplitude * np.sin(2 * np.pi * 61.3 * t + 2.0)
    line = strongest_line([train], [held], 1e-3, 10.0)
    assert line is not None
    assert line.frequency == pytest.approx(61.3, abs=0.5 / 9)
    assert line.p_value < 1e-6
    assert line.share == pytest.approx(0.5 * amplitude**2 / np.mean(held**2), rel=0.3)
    assert strongest_line([train[:200]], [held], 1e-3, 10.0) is None


def test_the_next_experiment_is_said_in_words_and_as_a_command() -> None:
    stribeck, dahl = catalogue()["stribeck_friction"], catalogue()["presliding_friction"]
    text = recommended_experiment(stribeck, "joint_3", [dahl])
    assert CONTAINS["slow"] in text
    assert text.count(CONTAINS["reversals"]) == 1
    assert text.endswith("armident trajectory --for stribeck_friction --joint joint_3 --against presliding_friction")
    assert recommended_experiment(catalogue()["payload"], "joint_6").endswith("--for payload")
    assert "wiring" in recommended_experiment(catalogue()["sign_error"], "joint_1")


def test_all_that_effects_ask_for_has_words() -> None:
    assert {tag for effect in catalogue().values() for tag in effect.excitation} <= set(CONTAINS)
