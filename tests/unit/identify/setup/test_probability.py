"""Probabilities of findings: what is one correction, what counts as better, and what is no correction to copy."""

from dataclasses import replace

import numpy as np
import pytest

from armident import Recording, check
from armident.configs import RobotConfig
from armident.identify.setup.calibration import CORRECTED, EXTREMES, FEATURES, probability
from armident.identify.setup.check import check_setup
from armident.identify.setup.contest import same_correction
from armident.identify.setup.fit import Hypothesis
from armident.identify.setup.prior import between, composed
from armident.identify.setup.search import Step
from armident.identify.setup.signals import absolute_findings
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups

AXES = 3
GRAVITY = np.array([0.0, 0.0, -9.81])


def hypothesis(position: tuple[float, ...] = (1, 1, 1), torque: tuple[float, ...] = (1, 1, 1)) -> Hypothesis:
    return Hypothesis(np.diag(position), np.diag(torque), GRAVITY, np.zeros(AXES))


def test_one_correction_at_a_joint_is_independent_of_the_others() -> None:
    one, two = hypothesis(torque=(1, -1, 1)), hypothesis(torque=(-1, -1, 5))
    assert same_correction("torque_sign", [1], one, two)
    assert not same_correction("torque_sign", [0, 1], one, two)
    assert not same_correction("torque_unit", [2], one, two)


def test_factors_are_one_correction_within_a_tenth_and_proportions_without_their_common_factor() -> None:
    assert same_correction("torque_unit", [1], hypothesis(torque=(1, 9.81, 1)), hypothesis(torque=(1, 9.5, 1)))
    assert not same_correction("torque_unit", [1], hypothesis(torque=(1, 9.81, 1)), hypothesis(torque=(1, 8, 1)))
    one, two = hypothesis(torque=(0.2, 0.4, 0.6)), hypothesis(torque=(1, 2, 3))
    assert same_correction("torque_unit", [0, 1, 2], one, two, each_own=True)
    assert not same_correction("torque_unit", [0, 1, 2], one, two)


def test_gravity_clock_and_shift_are_compared_as_such() -> None:
    own = hypothesis()
    tilted = replace(own, gravity=np.array([0.0, 0.5, -9.8]))
    assert same_correction("gravity_direction", [0], own, tilted)
    assert not same_correction("gravity_direction", [0], own, replace(own, gravity=np.array([9.81, 0.0, 0.0])))
    assert not same_correction("gravity_missing", [0], own, replace(own, gravity=np.zeros(3)))
    assert not same_correction("time_unit", [0], own, replace(own, clock=1e-3))
    late, later = (replace(own, shift=np.full(AXES, s)) for s in (10e-3, 12e-3))
    assert same_correction("time_shift", [0], late, later)
    assert not same_correction("time_shift", [0], late, replace(own, shift=np.full(AXES, -10e-3)))


def test_a_step_without_a_mistake_keeps_the_others() -> None:
    own = hypothesis()
    turned = hypothesis(torque=(1, -1, 1))
    tilted = replace(turned, gravity=np.array([9.81, 0.0, 0.0]))
    mistakes = (between(own, turned, "torque_sign", ""), between(turned, tilted, "gravity_direction", ""))
    np.testing.assert_array_equal(composed(own, mistakes).torque, turned.torque)
    step = Step(own, mistakes)
    np.testing.assert_array_equal(step.h.gravity, tilted.gravity)
    np.testing.assert_array_equal(step.without({0}).h.torque, np.eye(AXES))
    np.testing.assert_array_equal(step.without({0}).h.gravity, tilted.gravity)
    np.testing.assert_array_equal(step.without({1}).h.gravity, GRAVITY)


def test_a_probability_rises_with_the_odds_and_falls_with_the_error_left() -> None:
    names = list(FEATURES)
    middle = np.zeros(len(names))

    def at(name: str, value: float) -> float:
        features = middle.copy()
        features[names.index(name)] = value
        return probability(features)

    assert at("odds", 7.0) > at("odds", 0.0)
    assert at("error left at any joint", np.log(0.5)) < at("error left at any joint", np.log(0.05))
    assert EXTREMES[0] <= at("odds", -1e3) < at("odds", 1e3) <= EXTREMES[1]


def test_torques_without_sign_are_named_before_any_hypothesis(healthy: list[Experiment], arm: RobotConfig) -> None:
    absolute = [replace(e, tau=np.abs(e.tau)) for e in healthy]
    (finding,) = check_setup(absolute, arm).findings
    assert (finding.kind, finding.decisive) == ("torque_without_sign", True)
    # Gravity may keep one joint above zero.
    lifted = [replace(e, tau=e.tau - [0.0, e.tau[:, 1].min(), 0.0]) for e in healthy]
    assert absolute_findings(lifted, arm, np.ones(AXES, dtype=np.bool_)) == []


@pytest.mark.slow
def test_a_torque_of_another_recording_gives_no_correction_to_copy(healthy: list[Experiment], arm: RobotConfig) -> None:
    other = setups.record(arm, 1)
    mixed = []
    for e, of in zip(healthy, other, strict=True):
        tau = e.tau.copy()
        tau[:, 1] = of.tau[:, 1]
        mixed.append(replace(e, tau=tau))
    found = check_setup(mixed, arm)
    assert "axis_2" in found.joints_not_understood
    assert not any(f.correction and f.decisive for f in found.findings)
    assert found.corrected_robot is None


@pytest.mark.slow
def test_the_scale_of_all_torques_is_told_as_proportions(healthy: list[Experiment], arm: RobotConfig) -> None:
    rated = np.array([80.0, 300.0, 10.0])
    percent = setups.with_torques(healthy, np.diag(100.0 / rated))
    (finding,) = check_setup(percent, arm).findings
    assert finding.kind == "torque_unit"
    assert "does not determine the common factor" in finding.message
    assert "effects:" not in finding.remedy


@pytest.mark.slow
def test_a_certain_sign_has_a_line_to_copy_and_a_doubtful_one_the_next_step(
    healthy: list[Experiment], arm: RobotConfig
) -> None:
    (e,) = setups.with_torques(healthy[:1], setups.turned(AXES, 1))
    sure = check(Recording.from_arrays(e.dt * np.arange(len(e.q)), e.q, e.tau, robot=arm))
    (finding,) = sure.findings
    assert finding.correction
    assert finding.probability > CORRECTED
    assert "correct it by: effects:" in str(sure)
    unsure = finding.model_copy(update={"correction": False, "remedy": "move one joint at a time"})
    document = sure.document.model_copy(update={"findings": [unsure]})
    assert "next step: move one joint at a time" in str(replace(sure, document=document))
