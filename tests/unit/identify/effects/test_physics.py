"""Physical constraints on the parameters of effects."""

import numpy as np
import pytest

from armident.identify.effects.registry import known


@pytest.mark.parametrize(("value", "velocity", "allowed"), [(-5.0, 0.02, False), (5.0, 0.02, True), (-5.0, 0.3, True)])
def test_friction_does_not_fall_from_standstill(value: float, velocity: float, allowed: bool) -> None:
    effect = known("nonlinear_viscous_friction")
    assert effect.allows(np.array([value]), np.array([0.1]), {"velocity": velocity}, {"velocity": 0.35}) is allowed


@pytest.mark.parametrize(("inertia", "allowed"), [(-0.0028, True), (-0.055, False), (0.055, True)])
def test_a_sign_is_wrong_beyond_doubt_only(inertia: float, allowed: bool) -> None:
    values, std = np.array([inertia, 0.61, 1.84]), np.array([0.0035, 0.016, 0.064])
    assert known("coupling_friction").allows(values, std, {}) is allowed


@pytest.mark.parametrize(("gain", "std", "allowed"), [(-0.7, 0.04, False), (-0.62, 0.04, True), (1.7, 0.04, False)])
def test_a_gain_beyond_its_bounds_beyond_doubt_is_another_fault(gain: float, std: float, allowed: bool) -> None:
    assert known("drive_gain_error").allows(np.array([gain]), np.array([std]), {}) is allowed
