"""Table 5.2 on the simulated EMPS: ranking and orders of magnitude."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from armident.configs import DataError
from tests.reproduction.claims import JUDGEMENTS, derivatives
from tests.reproduction.context import Bench
from tests.reproduction.emps_derivatives import (
    COULOMB,
    GAIN,
    KP,
    KV,
    MASS,
    SIGN_SMOOTHING,
    THESIS,
    VISCOUS,
    Row,
    simulate_emps,
    table_5_2,
)
from tests.reproduction.emps_protocol import (
    INFERRED,
    SUFFIX,
    VARIANTS,
    evidence,
    inferred_rows,
    least_product,
    motion,
    product,
    same_ranking,
    worst_factor,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rows() -> dict[str, Row]:
    # Errors of 45000 samples differ from one realisation of the noise to the next by a per cent or two.
    return {row.label: row for row in table_5_2(simulations=3)}


def test_figures_of_the_irwsm_are_those_of_the_thesis_within_their_order_of_magnitude(rows: dict[str, Row]) -> None:
    for label in ("IRWSM 1", "IRWSM 2"):
        thesis = rows[label].thesis
        assert thesis is not None
        ratios = np.array(rows[label].ours) / np.array(thesis)
        assert (ratios < 10).all()
        assert (ratios > 0.1).all()


def test_positions_are_estimated_alike_and_in_the_order_of_the_thesis(rows: dict[str, Row]) -> None:
    bandpass, one, two = (rows[label].ours[0] for label in ("bandpass", "IRWSM 1", "IRWSM 2"))
    assert two < one < bandpass < 1.3 * two
    assert bandpass == pytest.approx(6.38e-5, rel=0.3)


def test_irwsm_beats_the_bandpass_on_velocity_and_acceleration(rows: dict[str, Row]) -> None:
    for label in ("IRWSM 1", "IRWSM 2"):
        assert rows[label].ours[1] < rows["bandpass"].ours[1]
        assert rows[label].ours[2] < 0.75 * rows["bandpass"].ours[2]
    assert rows["IRWSM 1"].ours[2] < rows["IRWSM 2"].ours[2]


def test_claim_3_holds_as_the_thesis_words_it(rows: dict[str, Row]) -> None:
    findings = derivatives(cast(Bench, SimpleNamespace(emps_derivatives=lambda: list(rows.values()))))
    assert len(findings) == 4
    assert all(finding.holds for finding in findings)
    (claim,) = (j for j in JUDGEMENTS if j.number == 3)
    assert "less than those of the bandpass" in claim.text


def test_acceleration_of_the_bandpass_is_wrong_by_about_a_per_cent(rows: dict[str, Row]) -> None:
    assert 0.3 < rows["bandpass"].ours[2] < 3.0


def test_forward_differences_alone_cost_the_velocity_of_the_bandpass_more_than_the_noise(rows: dict[str, Row]) -> None:
    assert rows["bandpass, forward differences"].ours[1] > 3 * rows["bandpass"].ours[1]
    # Half a sample late: half the period times the rms of acceleration over that of velocity.
    run = simulate_emps(2e-4)
    late = 50 * run.dt * np.linalg.norm(run.qdd) / np.linalg.norm(run.qd)
    assert rows["bandpass, forward differences"].ours[1] == pytest.approx(late, rel=0.1)


def test_ratio_chosen_by_default_beats_likelihood_and_tracking_error_in_every_signal(rows: dict[str, Row]) -> None:
    for label in ("IRWSM 1", "IRWSM 2"):
        for other in ("likelihood", "tracking error"):
            assert (np.array(rows[label].ours) < np.array(rows[f"{label}, {other}"].ours)).all()


def test_at_the_sampling_rate_of_the_recorded_emps_the_ranking_is_the_same() -> None:
    found = {row.label: row.ours for row in table_5_2(simulations=2, sampling_hz=1000.0)}
    for signal in range(3):
        assert found["IRWSM 1"][signal] < found["bandpass"][signal]
        assert found["IRWSM 2"][signal] < found["bandpass"][signal]


def test_simulation_agrees_with_an_integrator_of_variable_step() -> None:
    run = simulate_emps(1e-3)
    samples = 1200
    t = np.arange(run.q.size) * run.dt

    def motion(time: float, state: np.ndarray) -> list[float]:
        q, qd = state
        force = GAIN * KV * (KP * (np.interp(time, t, run.q_ref) - q) - qd)
        friction = VISCOUS * qd + COULOMB * 2 / np.pi * np.arctan(SIGN_SMOOTHING * qd)
        return [qd, (force - friction) / MASS]

    solution = solve_ivp(motion, (0, t[samples]), [0.0, 0.0], t_eval=t[:samples], rtol=1e-9, atol=1e-12, max_step=1e-3)
    # The reference is interpolated linearly there: off by up to a dt^2 / 8 = 2e-7 m where acceleration a = 1.4 m/s^2.
    np.testing.assert_allclose(run.q[:samples], solution.y[0], atol=3e-7)
    np.testing.assert_allclose(run.qd[:samples], solution.y[1], atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"), [({"simulations": 0}, "at least one"), ({"sampling_hz": 70.0}, "twice the cut-off")]
)
def test_what_cannot_be_simulated_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        table_5_2(**arguments)


# The protocol that the table's figures suggest


@pytest.fixture(scope="module")
def inferred() -> list[Row]:
    return inferred_rows(3)


def test_inferred_protocol_has_all_nine_figures_of_the_thesis_within_a_small_factor(inferred: list[Row]) -> None:
    assert worst_factor(inferred)[0] < 2.6
    assert same_ranking(inferred)


def test_thesis_columns_stand_beside_the_inferred_ones(inferred: list[Row]) -> None:
    assert [row.label for row in inferred] == [label + SUFFIX for label in THESIS]
    assert [row.thesis for row in inferred] == list(THESIS.values())


def test_factor_and_ranking_see_what_is_wrong() -> None:
    rows = [Row(label, figures, figures) for label, figures in THESIS.items()]
    assert worst_factor(rows)[0] == 1.0
    assert same_ranking(rows)
    q, qd, qdd = THESIS["IRWSM 1"]
    rows[1] = Row("IRWSM 1", THESIS["IRWSM 1"], (q, 4 * qd, qdd))
    factor, which = worst_factor(rows)
    assert factor == pytest.approx(4.0)
    assert which == "velocity of IRWSM 1"
    assert not same_ranking(rows)


def test_half_a_sample_is_what_the_velocity_of_the_bandpass_is_wrong_by(inferred: list[Row]) -> None:
    run = motion(INFERRED)
    inner = slice(INFERRED.border, -INFERRED.border)
    late = 50 * run.dt * np.linalg.norm(run.qdd[inner]) / np.linalg.norm(run.qd[inner])
    assert inferred[0].ours[1] == pytest.approx(late, rel=0.02)
    centred = inferred_rows(1, VARIANTS["central differences"])
    assert centred[0].ours[1] < 0.1 * inferred[0].ours[1]
    # Then the thesis's 0.549 % is out of reach.
    assert worst_factor(centred)[0] > 10


def test_no_position_error_explains_the_velocity_and_acceleration_of_the_thesis_bandpass() -> None:
    least = least_product(THESIS["bandpass"])
    for name in ("moves of 0.25 m from rest to rest", "stroke of 0.25 m"):
        assert product(motion(VARIANTS[name])) < 0.01 * least
    assert product(motion(INFERRED)) < 0.01 * least
    # What our central differences leave does satisfy the inequality of Cauchy and Schwarz.
    moves = VARIANTS["moves of 0.25 m from rest to rest"]
    centred = inferred_rows(1, replace(moves, differences="central"))[0]
    assert least_product(centred.ours) < product(motion(moves))


def test_origin_moves_positions_and_nothing_else() -> None:
    at, away = motion(replace(INFERRED, origin=0.0)), motion(INFERRED)
    np.testing.assert_allclose(away.q - at.q, INFERRED.origin)
    np.testing.assert_array_equal(away.qd, at.qd)
    np.testing.assert_allclose(np.ptp(at.q_ref), INFERRED.stroke, rtol=1e-4)


def test_evidence_is_told_for_every_variant(inferred: list[Row]) -> None:
    lines = evidence(inferred)
    assert "ranking kept" in lines[1]
    for name in VARIANTS:
        assert any(line.startswith(f"inferred but {name}: factor") for line in lines)
