"""Standard deviations of effects, and the test of their parameters against zero."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.candidates import Candidate, ColumnCache, candidates
from armident.identify.diagnosis.model_state import ModelState, fitted, with_entries
from armident.identify.diagnosis.precision import p_value_of_effect, standard_deviations
from armident.identify.diagnosis.screening import contained
from armident.identify.diagnosis.study import build_study
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups
from tests.fixtures.diagnoses import SPRING, selection

SPRING_OF_JOINT_1 = Effect(effect="joint_spring", joint="joint_1")


def parallel_arm() -> RobotConfig:
    """Three joints, the first two with parallel axes."""
    arm = setups.random_arm(5, 3)
    second = arm.joints[1].model_copy(update={"mdh": arm.joints[1].mdh.model_copy(update={"alpha": 0.0})})
    return arm.model_copy(update={"joints": (arm.joints[0], second, arm.joints[2])})


def recorded(robot: RobotConfig) -> list[Experiment]:
    return setups.record(robot, 0, noise=0.003, dt=4e-3)


def pair_of(state: ModelState) -> tuple[Candidate, ColumnCache]:
    """Friction and inertia that the first two joints share."""
    cache = ColumnCache(state.study, state.fit.theta)
    pairs = (c for c in candidates(cache) if c.effect.name == "coupling_friction")
    return next(c for c in pairs if (c.place.joint, c.place.other) == (0, 1)), cache


@pytest.mark.slow
def test_parameters_of_an_effect_that_is_there_differ_from_zero_and_others_do_not() -> None:
    present, absent = (
        fitted(first.study, with_entries(first.robot, [SPRING_OF_JOINT_1]), first)
        for first in (selection(1, SPRING)[1], selection(1)[1])
    )
    assert p_value_of_effect(present, SPRING_OF_JOINT_1) < 1e-12
    assert p_value_of_effect(absent, SPRING_OF_JOINT_1) > 1e-3


@pytest.mark.slow
def test_the_test_of_one_parameter_is_that_of_its_standard_deviation() -> None:
    _, first = selection(1, SPRING)
    state = fitted(first.study, with_entries(first.robot, [SPRING_OF_JOINT_1]), first)
    number = list(state.robot.effects).index(SPRING_OF_JOINT_1)
    (value,), _ = state.values_of(state.term_of(SPRING_OF_JOINT_1))
    deviations = value / standard_deviations(state)[number]["ks"]
    assert p_value_of_effect(state, SPRING_OF_JOINT_1) == pytest.approx(
        float(stats.chi2.sf(deviations**2, 1)), rel=1e-6
    )


def test_the_value_of_a_correction_is_tested_too() -> None:
    robot = setups.random_arm(3, 4)
    experiments = recorded(robot)
    wrong = [replace(e, tau=e.tau * np.array([1.0, 1.25, 1.0, 1.0])) for e in experiments]
    entry = Effect(effect="drive_gain_error", joint=robot.joints[1].name, parameters={"gain_error": 0.25})
    exact = robot.model_copy(update={"effects": (entry,)})
    assert p_value_of_effect(fitted(build_study(wrong, [], exact), exact, None), entry) < 1e-12


def test_an_inertia_of_two_parallel_joints_belongs_to_the_rigid_model() -> None:
    found = []
    for robot in (parallel_arm(), setups.random_arm(5, 3)):
        state = fitted(build_study(recorded(robot), [], robot), robot, None)
        candidate, cache = pair_of(state)
        found.append(contained(state.fit, candidate, cache, ()))
    assert found == [("iac",), ()]


def test_what_rigid_model_and_term_both_give_belongs_to_the_rigid_model() -> None:
    """The load never comes near the first knots of the table: its other functions add up to the offset."""
    robot = setups.random_arm(3, 4)
    first = fitted(build_study(recorded(robot), [], robot), robot, None)
    torque = np.concatenate([s.y[:, 1] for s in first.study.train])
    ends = {"low": float(-20 * np.abs(torque).max()), "high": float(np.abs(torque).max())}
    entry = Effect(effect="unnamed", law="torque", joint=robot.joints[1].name, parameters=ends)
    state = fitted(first.study, with_entries(first.robot, [entry]), first)
    values, _ = state.values_of(state.term_of(entry))
    assert np.isfinite(state.fit.theta).all()
    np.testing.assert_array_equal(values[:4], 0.0)
    np.testing.assert_allclose(state.score.rms, first.score.rms, rtol=0.02)
    assert p_value_of_effect(state, entry) > 1e-6
