"""Joint Gauss-Newton refinement of the nonlinear parameters of findings."""

from dataclasses import replace

import numpy as np
import pytest

from armident.configs import load_robot
from armident.configs.schema.robot import Effect
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.polishing import polished
from armident.identify.diagnosis.regression import fit
from armident.identify.diagnosis.state import refit
from armident.identify.diagnosis.study import Study, build_study
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import recording

pytestmark = pytest.mark.slow

LINK, RESONANCE = 0.7 * 95.0, 12.0
"""Mass on the spring, kg, and its frequency behind a motor that is held, Hz."""


@pytest.fixture(scope="module")
def study() -> Study:
    """EMPS whose carriage hangs on a spring."""
    robot = load_robot("emps")
    stiffness = LINK * (2 * np.pi * RESONANCE) ** 2
    hidden = HiddenEffect(effect="joint_elasticity", joint="joint_1", parameters={"stiffness": stiffness})
    data = recording("emps", "emps_excitation", 3, hidden)
    experiments, _ = experiments_from_recording(data, robot)
    return build_study(experiments, [], robot)


def with_spring(study: Study, frequency: float, damping: float) -> Effect:
    """Configuration entry of an elastic joint."""
    shapes = {"frequency": frequency, "damping": damping, "rotor": 0.0}
    return Effect(effect="joint_elasticity", joint="joint_1", parameters=shapes)


@pytest.mark.parametrize("frequency", [9.5, 15.0])
def test_a_wrong_resonance_and_its_damping_are_put_right_together(study: Study, frequency: float) -> None:
    robot = study.robot.model_copy(update={"effects": (with_spring(study, frequency, 0.3),)})
    rigid = fit(study)
    (found,) = polished(study, robot, rigid).effects
    # No motor inertia in the model: all mass is the link's, and the spring softer by as much.
    assert found.parameters["frequency"] == pytest.approx(RESONANCE, rel=0.06)
    assert found.parameters["damping"] < 0.1
    before, after = (
        refit(study, study.robot.model_copy(update={"effects": (stanza,)}), rigid)[1]
        for stanza in (robot.effects[0], found)
    )
    errors = [np.sum(np.concatenate(one.errors(one.theta, held=True)) ** 2) for one in (before, after)]
    assert errors[1] < 0.7 * errors[0]


def test_effects_that_the_robot_came_with_stay(study: Study) -> None:
    robot = study.robot.model_copy(update={"effects": (with_spring(study, 15.0, 0.3),)})
    own = replace(study, robot=robot)
    assert polished(own, robot, fit(study)) == robot
