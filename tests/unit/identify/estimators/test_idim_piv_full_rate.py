"""IDIM-PIV without any decimation: the recorded rate of the virtual TX40, 5 kHz."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal, stats
from threadpoolctl import threadpool_limits

from armident.configs import load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.estimators.idim_piv import idim_piv
from armident.identify.identification.auxiliary_loop import closed_loop
from armident.identify.identification.equations import PIV_CUTOFF, Prepared, equations
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.identification.solvers import decimation_of
from armident.identify.regression.equations import (
    Estimate,
    ExperimentEquations,
    filtered_regressor,
    instrumented,
    thinned_regressor,
)
from armident.identify.regression.iv import iv_products
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.decimate import design
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.inertias import plant_parameters
from tests.fixtures.arms import recording

pytestmark = pytest.mark.slow

Floats = NDArray[np.float64]

BANDWIDTH_HZ = 10.0
"""Of the TX40 (section B.2)."""
BAND_HZ = PIV_CUTOFF * BANDWIDTH_HZ
SETPOINTS_HZ = 1000.0
"""Rate at which set points arrive at the drives."""


@cache
def model() -> ArmModel:
    return arm_model(load_robot("tx40"))


@cache
def truth() -> Floats:
    plant = plant_parameters(load_robot("tx40"))
    base: Floats = model().base.regroup @ np.array([plant[name] for name in model().names])
    return base


@cache
def recorded() -> tuple[Experiment, Derivatives]:
    (experiment,), _ = experiments_from_recording(recording("tx40", "tx40_excitation", 1), load_robot("tx40"))
    return experiment, differentiate(experiment.q, experiment.dt)


@cache
def loop(factor: int | None, band_hz: float) -> tuple[list[ExperimentEquations], AuxiliaryModel, Floats]:
    """Equations, closed loop with identified controller, and the estimate to start from."""
    experiment, motion = recorded()
    plain = decimation_of("idim-ls", experiment.dt, BANDWIDTH_HZ, None)
    ls = idim_ls(equations(model(), [experiment], [motion], plain), model().base.names)
    decimation = decimation_of("idim-piv", experiment.dt, BANDWIDTH_HZ, factor)
    options = Options(method="idim-piv", decimation=factor)
    prepared = Prepared(model(), [experiment], [motion])
    auxiliary, start, _, _ = closed_loop(prepared, options, ls.theta, decimation, BANDWIDTH_HZ)
    return list(equations(model(), [experiment], [motion], decimation)), replace(auxiliary, band_hz=band_hz), start


@cache
def estimated(factor: int | None, band_hz: float) -> Estimate:
    blocks, auxiliary, start = loop(factor, band_hz)
    with threadpool_limits(1):
        return idim_piv(blocks, auxiliary, start)


def test_every_sample_gives_what_the_rough_decimation_gives() -> None:
    full, rough = estimated(1, BAND_HZ), estimated(None, BAND_HZ)

    assert loop(1, BAND_HZ)[0][0].y.shape[0] == recorded()[0].q.shape[0]
    assert full.converged
    assert not full.warnings
    # Both contain all information below the band; only the noise models differ.
    assert np.max(np.abs(full.theta - rough.theta) / rough.std) < 1.0
    assert np.sqrt(np.mean(((full.theta - truth()) / full.std) ** 2)) < 1.5
    assert 0.8 < np.median(full.std / rough.std) < 1.25


def test_instruments_of_any_band_take_set_points_for_information_that_the_smoothed_regressor_lacks() -> None:
    blocks, auxiliary, _ = loop(1, np.inf)
    limited = estimated(1, BAND_HZ)

    unlimited = iv_products(instrumented(blocks, auxiliary.fresh().instruments(limited.theta)), limited.noise).theta

    assert np.max(np.abs(unlimited - limited.theta) / limited.std) > 10.0


def test_no_instrument_holds_the_rate_of_the_set_points_where_the_decimation_lets_it_through() -> None:
    def line(auxiliary: AuxiliaryModel) -> Floats:
        (zeta,) = auxiliary.fresh().instruments(truth())
        frequency, power = signal.welch(zeta @ truth(), 5000.0, "blackmanharris", 1000, axis=0)
        at, beside = (int(np.argmin(np.abs(frequency - hz))) for hz in (SETPOINTS_HZ, SETPOINTS_HZ - 100.0))
        return np.asarray(power[at] / power[beside], dtype=np.float64)

    assert np.all(line(loop(1, np.inf)[1]) > 100.0)
    assert np.all(line(loop(1, BAND_HZ)[1]) < 10.0)


def test_the_decimation_that_idim_piv_chooses_leaves_the_instruments_alone() -> None:
    _, auxiliary, start = loop(None, BAND_HZ)
    (run,) = auxiliary.fresh().simulate(start) or []

    (zeta,) = auxiliary.fresh().instruments(start)

    motion = Derivatives(run.q, run.qd, run.qdd, None)
    assert np.array_equal(zeta, thinned_regressor(model(), motion, auxiliary.decimation))
    every_sample = filtered_regressor(model(), motion, auxiliary.decimation)
    # Few samples: each column is as it was, up to dry friction where a joint turns round.
    size = np.sqrt(np.mean(every_sample**2, axis=(0, 1)))
    assert np.max(np.sqrt(np.mean((zeta - every_sample) ** 2, axis=(0, 1))) / size) < 0.02


@pytest.mark.parametrize("cutoff_hz", [13.0, 50.0, 77.0, 240.0, 999.0, 2400.0])
def test_no_chosen_decimation_is_wider_than_twice_the_band(cutoff_hz: float) -> None:
    """The factor is an integer; rounding it down widens the band by less than an octave."""
    factor = design(0.0002, cutoff_hz).factor

    assert 0.5 / (0.0002 * factor) < 2.0 * cutoff_hz


@pytest.mark.parametrize("name", ["emps", pytest.param("tx40", marks=pytest.mark.nightly)])
def test_identification_at_the_recorded_rate_converges_without_a_warning(name: str) -> None:
    robot = load_robot(name)
    experiments, _ = experiments_from_recording(recording(name, f"{name}_excitation", 1), robot)
    found = identify_experiment(experiments, robot, Options(method="idim-piv", decimation=1))
    plant, arm = plant_parameters(robot), arm_model(robot)
    squares = ((found.theta - arm.base.regroup @ np.array([plant[n] for n in arm.names])) / found.std) ** 2

    assert found.converged
    assert not found.warnings
    assert not found.diagnostics.weak_instruments
    # Probability 0.999: 4.6 for the 4 parameters of the EMPS, 1.7 for the 61 of the TX40.
    assert np.mean(squares) < stats.chi2.ppf(0.999, squares.size) / squares.size
