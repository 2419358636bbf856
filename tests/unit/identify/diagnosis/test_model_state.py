"""Model of a step: values of its effects, its configuration, and its loop on the report part."""

import numpy as np
import pytest

from armident.configs.schema.robot import Effect
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.model_state import acted_on, rigid_parameters, viscous_friction_rises, with_report_part
from armident.identify.effects.terms import arm_model
from tests.fixtures.arms import hide
from tests.fixtures.diagnoses import SPRING, selection, with_effects

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
    assert viscous_friction_rises(state, state.term_of(entry)) is rises
