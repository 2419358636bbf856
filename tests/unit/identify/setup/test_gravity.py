"""Search for the direction of gravity."""

import numpy as np
import pytest

from armident.identify.setup.fit import Hypothesis, Misfit
from armident.identify.setup.gravity import best_direction


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_of_opposite_directions_that_fit_alike_the_one_near_the_configuration_is_taken(side: float) -> None:
    true = np.array([0.9, 0.0, -np.sqrt(9.81**2 - 0.9**2)])
    configured = Hypothesis(np.eye(2), np.eye(2), np.array([0.0, 0.0, -9.81 * side]), np.zeros(2))

    def misfit(h: Hypothesis) -> Misfit:
        # Slightly in favour of the direction far from the configuration.
        value = 1.0 - abs(h.gravity @ true) / 9.81**2 + 0.002 * side * np.sign(h.gravity @ -true)
        return Misfit(float(value))

    np.testing.assert_allclose(best_direction(configured, misfit).gravity, side * true, atol=0.1)
