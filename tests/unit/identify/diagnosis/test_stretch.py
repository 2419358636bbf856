"""Segments that a diagnosis cuts from recordings."""

from dataclasses import replace

import numpy as np
import pytest

from armident.configs import load_robot
from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.study import Study, build_study
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import recording


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
