"""A decimation leaves at least ten equations per parameter, whatever the bandwidth."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armident.configs import load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.methods import Method
from armident.identify.estimators.reason import Reason
from armident.identify.identification.equations import (
    EQUATIONS_PER_PARAMETER,
    LS_CUTOFF,
    PIV_CUTOFF,
    decimated_rows,
    equations,
    least_rows,
    sufficient,
)
from armident.identify.identification.solvers import decimation_of
from armident.identify.signals.decimate import design
from armident.identify.signals.differentiate import differentiate
from armident.identify.signals.experiments import Experiment

DT = 5e-3
SAMPLES = (5000, 5000)


@pytest.mark.parametrize("robot", ["tx40", "emps", "kuka_lwr4", "panda"])
def test_the_fewest_rows_give_every_robot_ten_equations_per_parameter(robot: str) -> None:
    model = arm_model(load_robot(robot))
    rows = least_rows(model)
    assert rows * model.n >= EQUATIONS_PER_PARAMETER * model.base.b > (rows - 1) * model.n


def test_a_decimation_that_leaves_enough_stays_as_it_is() -> None:
    wanted = design(DT, 4.0)
    assert sufficient(wanted, DT, SAMPLES, decimated_rows(wanted, SAMPLES)) is wanted


@pytest.mark.slow
@given(
    dt=st.sampled_from([2e-4, 1e-3, 5e-3]),
    cutoff=st.floats(0.05, 20.0),
    seconds=st.lists(st.floats(0.5, 20.0), min_size=1, max_size=4),
    rows=st.integers(1, 400),
)
def test_enough_rows_are_left_and_not_many_more(dt: float, cutoff: float, seconds: list[float], rows: int) -> None:
    samples = [math.ceil(s / dt) for s in seconds]
    wanted = design(dt, cutoff)
    found = sufficient(wanted, dt, samples, rows)
    if sum(samples) < rows:
        assert found.factor == 1
        return
    assert decimated_rows(found, samples) >= rows
    if found.factor < wanted.factor and found.factor + 1 < wanted.factor:
        stronger = design(dt, 0.5 / (dt * (found.factor + 1)), found.factor + 1)
        assert decimated_rows(stronger, samples) < rows


@pytest.mark.parametrize("method", ["idim-ls", "idim-piv"])
def test_slow_motion_raises_the_cut_off_and_says_so(method: Method) -> None:
    warnings: list[str] = []
    found = decimation_of(method, DT, 0.1, None, samples=SAMPLES, rows=92, warnings=warnings)
    assert decimated_rows(found, SAMPLES) >= 92
    (warning,) = warnings
    share = PIV_CUTOFF if method == "idim-piv" else LS_CUTOFF
    assert f"A cut-off of {0.1 * share:.3g} Hz leaves" in warning
    assert "fewer than 92: raised to" in warning


def test_a_motion_fast_enough_is_not_warned_about() -> None:
    warnings: list[str] = []
    found = decimation_of("idim-ls", DT, 2.0, None, samples=SAMPLES, rows=92, warnings=warnings)
    assert found.factor == 25
    assert not warnings


def test_a_factor_by_hand_stands_and_makes_the_result_doubtful() -> None:
    reasons: list[Reason] = []
    found = decimation_of("idim-ls", DT, 2.0, 250, samples=SAMPLES, rows=92, reasons=reasons)
    assert found.factor == 250
    (reason,) = reasons
    assert reason.level == "doubtful"
    assert "decimation by 250 leaves 6 equations per joint, fewer than 92" in reason.message
    assert reason.next_step == "record longer or decimate less"


def test_a_recording_too_short_for_any_decimation_keeps_all_samples_and_is_doubtful() -> None:
    reasons: list[Reason] = []
    found = decimation_of("idim-ls", DT, 2.0, None, samples=(80,), rows=92, reasons=reasons)
    assert found.factor == 1
    (reason,) = reasons
    assert "leaves 80 equations per joint, fewer than 92" in reason.message
    assert reason.next_step == "record longer"


def test_equations_of_slow_motion_are_as_many_as_promised() -> None:
    model = arm_model(load_robot("emps"))
    t = np.arange(4000)[:, None] * DT
    q = 0.2 * np.sin(2 * np.pi * 0.05 * t)
    rows = least_rows(model)
    decimation = decimation_of("idim-ls", DT, 0.25, None, samples=[len(q)], rows=rows)
    assert decimated_rows(design(DT, LS_CUTOFF * 0.25), [len(q)]) < rows
    experiment = Experiment(q, np.zeros_like(q), None, DT)
    (block,) = equations(model, [experiment], [differentiate(q, DT, nvr=1e-3)], decimation)
    assert rows <= len(block.y) < 1.1 * rows
