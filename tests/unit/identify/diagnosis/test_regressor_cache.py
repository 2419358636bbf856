"""Cache of regressors: least recently used arrays go first, and cached regressors are those of a fresh study."""

from dataclasses import replace

import numpy as np
import pytest

from armident.configs import load_robot
from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.model_equations import regressors
from armident.identify.diagnosis.regressor_cache import Arrays, RegressorCache
from armident.identify.diagnosis.stretch import KINDS
from armident.identify.diagnosis.study import Study, build_study
from armident.identify.effects.terms import arm_model
from armident.identify.identification.from_recording import experiments_from_recording
from tests.fixtures.arms import recording

ELASTIC = {"frequency": 20.0, "damping": 0.1, "rotor": 0.0}
EFFECTS = (
    Effect(effect="stribeck_friction", joint="joint_1", parameters={"velocity": 0.02}),
    Effect(effect="joint_elasticity", joint="joint_1", parameters=ELASTIC),
    Effect(effect="backlash", joint="joint_1", parameters={"gap": 1e-4, "rotor": 0.0}),
)
"""Computed from measured signals, from simulated ones, and from measured ones even as instruments."""


@pytest.fixture(scope="module")
def study() -> Study:
    """EMPS without effects."""
    robot = load_robot("emps")
    experiments, _ = experiments_from_recording(recording("emps", "emps_excitation", 0), robot)
    return build_study(experiments, [], robot)


def test_the_array_that_was_not_used_for_the_longest_time_goes_first() -> None:
    cache, computed = RegressorCache(most_bytes=2 * 80), []

    def get(key: str) -> Arrays:
        def made() -> Arrays:
            computed.append(key)
            return (np.zeros(10),)

        return cache.get(key, made)

    for key in ("a", "b", "a", "c", "a", "b"):
        get(key)
    assert computed == ["a", "b", "c", "b"]


def test_an_array_larger_than_the_memory_is_returned_all_the_same() -> None:
    cache = RegressorCache(most_bytes=8)
    assert cache.get("a", lambda: (np.ones(10),))[0].sum() == 10.0


@pytest.mark.slow
def test_cached_regressors_are_those_of_a_fresh_study(study: Study) -> None:
    for entries in (EFFECTS, EFFECTS[:2], EFFECTS[1:]):
        changed = study.of_robot(study.robot.model_copy(update={"effects": entries}))
        theta = np.concatenate([[95.0, 203.0, 20.0, 0.0], np.zeros(changed.model.e)])
        fresh = replace(changed, model=arm_model(changed.robot), regressors=RegressorCache())
        for stretch in changed.train:
            for kept, again in zip(regressors(changed, stretch, theta), regressors(fresh, stretch, theta), strict=True):
                np.testing.assert_array_equal(kept, again)


def test_terms_use_the_signals_that_their_effect_asks_for(study: Study) -> None:
    changed = study.of_robot(study.robot.model_copy(update={"effects": EFFECTS}))
    theta = np.concatenate([[95.0, 203.0, 20.0, 0.0], np.zeros(changed.model.e)])
    (stretch,) = changed.train
    x, z = regressors(changed, stretch, theta)
    measured, simulated = (changed.decimation(changed.terms(stretch, kind, theta)) for kind in KINDS)
    moving = stretch.moving[:, :, None]
    for found, wanted in ((x, (measured, simulated, measured)), (z, (simulated, simulated, measured))):
        for k, columns in enumerate(wanted):
            np.testing.assert_allclose(found[:, :, 4 + k], (columns * moving)[:, :, k], rtol=1e-9, atol=1e-12)
