"""Choice of the next motion: what tells two explanations apart most per second of robot time."""

import numpy as np
import pytest

import armident
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.model_state import ModelState, fitted, fitted_in_loop_of, with_entries
from armident.identify.diagnosis.probabilities import NOTHING
from armident.identify.diagnosis.study import build_study
from armident.identify.documents.diagnosis import Explanation
from armident.identify.identification.from_recording import experiments_of
from armident.identify.investigation.motions import ConstantSpeeds, Reversals, Steps, reach_of
from armident.identify.investigation.question import Question, question
from armident.identify.investigation.rivals import Rival, entropy, rivals_of, uncertain, with_decided

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def state() -> ModelState:
    recording = armident.simulate_recording("emps", "emps_excitation", scenario="emps_dry_screw", seed=1)
    experiments, _ = experiments_of([recording], recording.robot, name_files=False)
    study = build_study(experiments, [], recording.robot)
    return fitted(study, study.robot, None)


def rival(state: ModelState, effect: str, probability: float, **shapes: float) -> Rival:
    entry = Entry(effect=effect, joint="joint_1", parameters=shapes)
    made = fitted_in_loop_of(state, with_entries(state.robot, [entry]))
    assert made is not None
    term = made.term_of(entry)
    return Rival(effect, probability, term, made.values_of(term)[0])


@pytest.fixture(scope="module")
def springs(state: ModelState) -> Question:
    return question(state, [rival(state, "asymmetric_viscous_friction", 0.5), Rival(NOTHING, 0.5)])


def test_the_expected_gain_is_between_zero_and_the_entropy(state: ModelState, springs: Question) -> None:
    reach = reach_of(state.robot, np.zeros(1), np.array([0.5]), np.array([2.0]))
    for family in (ConstantSpeeds(), Reversals(), Steps()):
        for size in family.sizes:
            gain = springs.gain(family.trajectory(reach, 0, size))
            assert 0.0 <= gain <= entropy([0.5, 0.5]) + 1e-9


def test_a_fast_motion_tells_viscous_friction_and_one_of_tiny_steps_does_not(
    state: ModelState, springs: Question
) -> None:
    reach = reach_of(state.robot, np.zeros(1), np.array([0.5]), np.array([2.0]))
    fast, tiny = ConstantSpeeds().trajectory(reach, 0, 0.4), Steps().trajectory(reach, 0, 0.001)
    per_second = [springs.gain(one) / one.duration for one in (fast, tiny)]
    assert per_second[0] > 5.0 * per_second[1]


def test_a_longer_motion_of_the_same_kind_tells_more(state: ModelState, springs: Question) -> None:
    reach = reach_of(state.robot, np.zeros(1), np.array([0.5]), np.array([2.0]))
    once = Reversals().trajectory(reach, 0, 0.1)
    twice = once.model_copy(update={"moves": once.moves * 2})
    assert springs.gain(twice) > springs.gain(once)


def test_explanations_without_a_name_are_represented_by_what_the_data_favour(state: ModelState) -> None:
    left = Explanation(joint="joint_1", names={"unnamed": 0.86, "nothing": 0.14}, likely=["unnamed"])
    found = rivals_of(state, left)
    assert len(found) == 4
    assert found[-1].name == NOTHING
    assert sum(one.probability for one in found) == pytest.approx(1.0)
    named = rivals_of(state, left.model_copy(update={"names": {"stribeck_friction": 0.7, "nothing": 0.3}}))
    assert [one.name for one in named] == ["stribeck_friction", NOTHING]


def test_what_is_decided_is_part_of_the_model_that_is_asked(state: ModelState) -> None:
    entry = Entry(effect="asymmetric_viscous_friction", joint="joint_1")
    found = with_entries(state.robot, [entry])
    sure = Explanation(joint="joint_1", names={entry.effect: 0.95, "nothing": 0.05}, likely=[entry.effect])
    asked = with_decided(state, found, [sure])
    assert asked.robot.effects == (*state.robot.effects, entry)
    assert asked.fit.theta.size == state.fit.theta.size + 1
    doubtful = sure.model_copy(update={"likely": [entry.effect, "nothing"]})
    assert with_decided(state, found, [doubtful]) is state


def test_only_undecided_joints_are_asked_the_most_uncertain_one_first() -> None:
    def one(joint: str, likely: list[str], **names: float) -> Explanation:
        return Explanation(joint=joint, names=names, likely=likely)

    decided = one("joint_1", ["stribeck_friction"], stribeck_friction=0.97, nothing=0.03)
    healthy = one("joint_2", ["nothing"], nothing=0.96, unnamed=0.04)
    open_ = one("joint_3", ["backlash", "nothing"], backlash=0.5, nothing=0.5)
    nearly = one("joint_4", ["backlash", "nothing"], backlash=0.88, nothing=0.12)
    assert [each.joint for each in uncertain([decided, healthy, nearly, open_])] == ["joint_3", "joint_4"]
