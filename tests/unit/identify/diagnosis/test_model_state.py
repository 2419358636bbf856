"""Model of a step: values of its effects, its configuration, and its loop on the report part."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from armident.configs.schema.robot import Effect
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.model_state import (
    acted_on,
    fitted,
    friction_allowed,
    rigid_parameters,
    with_report_part,
)
from armident.identify.diagnosis.study import build_study
from armident.identify.effects.terms import arm_model
from tests.fixtures import setups
from tests.fixtures.arms import hide
from tests.fixtures.diagnoses import SPRING, selection, with_effects
from tests.fixtures.setups import random_arm

pytestmark = pytest.mark.slow

TERM = Effect(effect="joint_spring", joint="joint_1")


def test_values_of_an_effect_are_right_within_their_uncertainty() -> None:
    state = with_effects(selection(1, SPRING)[1], TERM)
    values, std = state.values_of(state.term_of(TERM))
    assert abs(values[0] - 80.0) < 4.0 * std[0]


def test_the_configuration_contains_the_values() -> None:
    state = with_effects(selection(1, SPRING)[1], TERM)
    values, _ = state.values_of(state.term_of(TERM))
    entry = next(e for e in state.with_values().effects if e.effect == "joint_spring")
    assert entry.parameters["ks"] == pytest.approx(values[0])
    assert arm_model(state.with_values()).base.names == state.study.model.base.names


def test_a_larger_model_begins_with_the_rigid_parameters_of_the_smaller_one() -> None:
    first = selection(1, SPRING)[1]
    state = with_effects(first, TERM)
    start = rigid_parameters(first.fit, state.study.model)
    rigid = state.study.model.base.b - state.study.model.e
    np.testing.assert_array_equal(start[:rigid], first.fit.theta[:rigid])
    assert not start[rigid:].any()


def test_a_correction_of_the_recordings_acts_on_all_joints_also_beside_a_term() -> None:
    first = selection(
        5, hide("asymmetric_viscous_friction", "joint_2", fva=0.3 * 5.5), arm="tx40", motion="tx40_excitation"
    )[1]
    term = Effect(effect="asymmetric_viscous_friction", joint="joint_2")
    correction = Effect(effect="drive_gain_error", joint="joint_4", parameters={"gain_error": 0.05})
    with_term = with_effects(first, term)
    np.testing.assert_array_equal(acted_on(with_term, first), np.arange(6) == 1)
    assert acted_on(with_effects(first, correction), first).all()
    assert acted_on(with_effects(first, term, correction), first).all()
    np.testing.assert_array_equal(
        acted_on(with_effects(first, term, correction), with_effects(first, correction)), np.arange(6) == 1
    )


def test_the_report_part_changes_no_parameter() -> None:
    state = with_effects(selection(1, SPRING)[1], TERM)
    whole = with_report_part(state)
    np.testing.assert_array_equal(whole.fit.theta, state.fit.theta)
    errors = [np.linalg.norm(s.simulated.qd - s.measured.qd) for s in whole.study.held]
    size = [np.linalg.norm(s.measured.qd) for s in whole.study.held]
    assert sum(errors) < 0.1 * sum(size)


@pytest.mark.parametrize(
    ("hidden", "rises"),
    [
        (hide("nonlinear_viscous_friction", "joint_1", thinning=0.3), True),
        (hide("stribeck_friction", "joint_1", extra=15.0, velocity=0.03), False),
    ],
    ids=["shear thinning", "Stribeck"],
)
def test_friction_that_falls_with_the_speed_is_not_viscous(hidden: HiddenEffect, rises: bool) -> None:
    entry = Effect(effect="nonlinear_viscous_friction", joint="joint_1", parameters={"velocity": 0.03})
    state = with_effects(selection(1, hidden)[1], entry)
    assert friction_allowed(state, state.term_of(entry)) is rises


@pytest.mark.parametrize(("kind", "allowed"), [("Stribeck", True), ("churning", False)])
def test_friction_that_rises_at_every_speed_is_not_stribeck(kind: str, allowed: bool) -> None:
    """The law of Stribeck with a large velocity fits it, beside a negative Coulomb friction."""
    robot, made = random_arm(3, 3), []
    for e in setups.record(robot, 0, noise=0.003):
        speed = np.gradient(e.q[:, 0], e.dt)
        share = speed / np.abs(speed).max()
        size = np.exp(-np.abs(share) / 0.1) if kind == "Stribeck" else 20.0 * share**2
        tau = e.tau.copy()
        tau[:, 0] += signal.lfilter([0.5, 0.5], [1.0], size * np.tanh(share / 0.003))
        made.append(replace(e, tau=tau))
    study = build_study(made, [], robot)
    velocity = (0.1 if kind == "Stribeck" else 0.35) * float(np.abs(speed).max())
    entry = Effect(effect="stribeck_friction", law="exponential", joint="axis_1", parameters={"velocity": velocity})
    state = with_effects(fitted(study, study.robot, None), entry)
    assert float(state.values_of(state.term_of(entry))[0][0]) > 0.0
    assert friction_allowed(state, state.term_of(entry)) is allowed
