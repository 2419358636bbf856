"""Physical constraints on the parameters of effects."""

import numpy as np
import pytest

from armident.identify.effects.registry import known


def test_the_slope_of_nonlinear_viscous_friction_at_rest_is_that_of_its_column() -> None:
    effect, velocity = known("nonlinear_viscous_friction"), 0.02
    step = 1e-6 * velocity
    slope = np.arcsinh(step / velocity) / step
    friction, factors = effect.positive_friction({"velocity": velocity})
    assert friction == "fv"
    assert factors == pytest.approx([slope])


@pytest.mark.parametrize(
    ("name", "friction", "factor"),
    [("stribeck_friction/exponential", "fc", 0.0), ("coulomb_transition", "fc", -0.5), ("joint_spring", "", 0.0)],
)
def test_stribeck_friction_falls_to_the_coulomb_friction_and_a_transition_is_at_most_twice_that(
    name: str, friction: str, factor: float
) -> None:
    found, factors = known(name).positive_friction({"velocity": 0.02})
    assert found == friction
    assert factors == pytest.approx([factor])


@pytest.mark.parametrize(("inertia", "allowed"), [(-0.0028, True), (-0.055, False), (0.055, True)])
def test_a_sign_is_wrong_beyond_doubt_only(inertia: float, allowed: bool) -> None:
    values, std = np.array([inertia, 0.61, 1.84]), np.array([0.0035, 0.016, 0.064])
    assert known("coupling_friction").allows(values, std, {}) is allowed


@pytest.mark.parametrize(("gain", "std", "allowed"), [(-0.7, 0.04, False), (-0.62, 0.04, True), (1.7, 0.04, False)])
def test_a_gain_beyond_its_bounds_beyond_doubt_is_another_fault(gain: float, std: float, allowed: bool) -> None:
    assert known("drive_gain_error").allows(np.array([gain]), np.array([std]), {}) is allowed
