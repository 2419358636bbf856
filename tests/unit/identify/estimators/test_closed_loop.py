"""Replacement of the identified controller where its closed loop does not move like the robot."""

from functools import partial

import numpy as np
import pytest

from armident.configs import load_robot
from armident.identify.estimators import idim_piv as module
from armident.identify.estimators.methods import Method
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.signals.experiments import Experiment
from tests.fixtures.arms import recording

pytestmark = pytest.mark.slow

SLOW = 0.002
"""Sampling period, s, at which the identified controller of the TX40 oscillates in simulation."""


@pytest.fixture(scope="module")
def at_500_hz() -> list[Experiment]:
    slow = recording("tx40", "tx40_excitation", 2, period=SLOW, setpoint_every=1)
    return list(experiments_from_recording(slow, load_robot("tx40.yaml"))[0])


@pytest.mark.parametrize("method", [pytest.param("idim-iv", marks=pytest.mark.nightly), "idim-piv"])
def test_a_loop_at_the_edge_of_stability_is_replaced(at_500_hz: list[Experiment], method: Method) -> None:
    """The iterates do not settle with the identified controller; with a stiff one they converge near least squares."""
    found = identify_experiment(at_500_hz, load_robot("tx40.yaml"), Options(method=method))
    assert found.converged
    assert found.controller["kind"] == "nominal"
    assert any("A stiff PD controller is used" in warning for warning in found.warnings)
    ls, ls_std = found.idim_ls
    assert np.all(found.std < 10 * ls_std)
    essential = found.essential
    assert np.all(np.abs(found.theta - ls)[essential] < 0.3 * np.abs(ls)[essential] + 6 * found.std[essential])


def test_idim_iv_replaces_a_prefilter_that_does_not_converge(
    at_500_hz: list[Experiment], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same iterations, stopped after the first: the estimate is that of IDIM-IV, which converges."""
    monkeypatch.setattr(module, "idim_piv", partial(module.idim_piv, iterations=1))
    robot = load_robot("tx40.yaml")
    found = identify_experiment(at_500_hz, robot, Options())
    assert found.converged
    (reason,) = found.verdict.of_kind("convergence")
    assert "idim-piv did not converge (stopped after 1 iterations)" in reason.message
    without = identify_experiment(at_500_hz, robot, Options(method="idim-iv"))
    np.testing.assert_allclose(found.theta, without.theta, rtol=0, atol=1e-9)
    # The covariance of both allows for serial correlation.
    np.testing.assert_allclose(found.std, without.std, rtol=1e-9)
