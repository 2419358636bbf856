"""Transitions of dry friction: found as they are, and no place for friction that falls with the velocity."""

import numpy as np
import pytest

from armident.configs import RobotConfig
from armident.identify.diagnosis.model_state import ModelState, fitted
from armident.identify.diagnosis.study import build_study
from armident.identify.diagnosis.transitions import with_transitions
from armident.identify.effects.effect import Place
from armident.identify.effects.registry import known
from tests.fixtures import setups
from tests.fixtures.setups import random_arm

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def base() -> ModelState:
    robot = random_arm(3, 4)
    study = build_study(setups.record(robot, 0), [], robot)
    return fitted(study, study.robot, None)


def test_transitions_predict_the_torques_of_their_joints_better(base: ModelState) -> None:
    def model(robot: RobotConfig, before: ModelState) -> ModelState:
        return fitted(base.study, robot, before)

    state = with_transitions(base, model)
    entries = [entry for entry in state.robot.effects if entry.effect == "coulomb_transition"]
    assert entries
    gains = state.score.own_log_likelihoods - base.score.own_log_likelihoods
    for entry in entries:
        joint = base.study.joints.index(entry.joint)
        value, std = (float(x[0]) for x in state.values_of(state.term_of(entry)))
        dry = float(state.fit.theta[state.study.model.base.names.index(f"fc{joint + 1}")])
        assert gains[joint] > 0.0
        assert 0.0 < value < 2.0 * dry + 4.0 * std
        assert entry.parameters["lead"] > 0.0


def test_the_lead_moves_the_reversal_of_friction_to_earlier_times(base: ModelState) -> None:
    effect, motion = known("coulomb_transition"), base.study.motion(base.study.train[0], "measured", base.fit.theta)
    top = float(motion.top_speed[0])
    late, early = (
        effect.columns(motion, Place(0), {"velocity": 0.01 * top, "lead": lead})[:, 0] + motion.sign[:, 0]
        for lead in (0.0, 4.0 * motion.dt)
    )
    falls = np.flatnonzero((late[:-1] > 0.0) & (late[1:] <= 0.0))
    assert falls.size
    assert np.median(early[falls]) < 0.0 < np.median(late[falls])
