"""Segments that a diagnosis cuts from recordings."""

from dataclasses import replace

import numpy as np
import pytest

from armident.configs import load_robot
from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.stretch import dragged_joints
from armident.identify.diagnosis.study import Study, build_study
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups
from tests.fixtures.arms import recording
from tests.fixtures.setups import random_arm


@pytest.fixture(scope="module")
def study() -> Study:
    """EMPS with presliding friction over 2 cm."""
    robot = load_robot("emps")
    data = recording("emps", "emps_excitation", 0)
    experiments, _ = experiments_from_recording(data, robot)
    yielding = Effect(effect="presliding_friction", joint="joint_1", parameters={"displacement": 0.02, "fcd": -5.0})
    return build_study(experiments, [], robot.model_copy(update={"effects": (yielding,)}))


def test_the_held_out_part_has_a_past_and_the_training_part_has_none(study: Study) -> None:
    assert [s.before for s in study.train] == [None] * len(study.train)
    (held,) = study.held
    assert held.before is not None
    measured, simulated = held.before
    assert measured.q.shape == simulated.q.shape == held.measured.q.shape
    # The past ends one sample before the part begins.
    assert measured.start + study.dt * measured.q.shape[0] == pytest.approx(held.measured.start)


def test_what_has_a_memory_goes_on_where_it_was(study: Study) -> None:
    (train,), (held,) = study.train, study.held
    theta = np.concatenate([[95.0, 203.0, 20.0, 0.0], [-5.0]])
    assert theta.size == study.model.base.b
    model = study.model
    whole = model.motion(
        np.concatenate([train.measured.q, held.measured.q]),
        np.concatenate([train.measured.qd, held.measured.qd]),
        np.concatenate([train.measured.qdd, held.measured.qdd]),
        study.dt,
    )
    anchored = type(whole)(model, whole.q, whole.qd, whole.qdd, study.dt, 0.0, theta, study.duration)
    expected = model.term_regressor(anchored)[train.measured.q.shape[0] :]
    found = study.terms(held, "measured", theta)
    # A bristle forgets its past over a few displacements; the past that is kept goes over metres.
    np.testing.assert_allclose(found, expected, atol=1e-6)
    forgotten = study.terms(replace(held, before=None), "measured", theta)
    assert np.abs(forgotten - expected).max() > 0.1


def test_a_new_simulation_replaces_the_past_too(study: Study) -> None:
    (held,) = study.held
    whole = study.signals[0]
    factor = study.thinning.factor
    again = held.resimulated(whole, study.sample, factor)
    assert again.before is not None
    assert held.before is not None
    np.testing.assert_array_equal(again.simulated.q, held.measured.q)
    np.testing.assert_array_equal(again.before[1].q, held.before[0].q)
    assert again.before[1].start == held.before[1].start


@pytest.mark.parametrize(
    ("speeds", "dragged"),
    [
        ((1.0, 2.0, 3.0), (False, False, False)),
        ((0.5, 0.1, 0.3), (False, True, True)),
        ((0.15, 0.02, 0.01), (False, True, True)),
        # All are slow, or nothing moves: that is the motion.
        ((0.1, 0.15, 0.2), (False, False, False)),
        ((0.0, 0.0, 0.0), (False, False, False)),
    ],
)
def test_a_slow_joint_beside_one_that_moves_is_dragged(speeds: tuple[float, ...], dragged: tuple[bool, ...]) -> None:
    found = dragged_joints(np.array(speeds), np.array([1.0, 2.0, 3.0]), Criteria().dragged_speed)
    assert tuple(found) == dragged


def test_equations_of_joints_that_others_drag_do_not_count() -> None:
    robot = random_arm(3, 3)
    (fast, *_) = setups.record(robot, 0)
    slow = fast.q.copy()
    # The second and the third joint creep in the other recording.
    slow[:, 1:] = slow[:1, 1:] + 0.05 * (slow[:, 1:] - slow[:1, 1:])
    other = Experiment(slow, fast.tau, None, fast.dt)
    made = build_study([fast, other], [], robot)
    for stretches in (made.train, made.held):
        first, second = stretches
        assert first.moving.any(axis=0).all()
        assert second.moving.any(axis=0).tolist() == [True, False, False]
        assert not second.y[:, 1:].any()
