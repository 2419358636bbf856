"""Two-stage identification of controller and arm: figures for tables 5.3 and 5.4 (thesis section 5.2.1)."""

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armident.configs import DataError
from armident.identify.controller.crc import IdentifiedController
from armident.identify.controller.law import Structure
from armident.identify.controller.nominal import saturation
from armident.identify.controller.parametric import ControlLaw, identify_parametric
from armident.identify.estimators.idim_iv import idim_iv
from armident.identify.identification.auxiliary_loop import initial_parameters
from armident.identify.identification.identification_result import relative_torque_errors
from tests.reproduction.cached_estimates import Case, Laboratory, Run


@dataclass(frozen=True)
class TwoStages:
    """Errors and cost of identifying controller and arm from one recording.

    Parameters
    ----------
    distance
        RMS error of the parameters in standard deviations of IDIM-IV with the actual controller; about 1 if the
        identified controller is as good as the actual one.
    loop_pct
        Relative torque error of the simulated closed loop of both along the recorded reference; ``None`` if that
        simulation diverges.
    gain_pct
        Largest relative error of a drive's gains, percent; ``None`` if the controller has no gains.
    simulations, seconds
        Closed-loop simulations, and computing time of both stages without filters, s.
    """

    distance: float
    loop_pct: float | None
    gain_pct: float | None
    simulations: int
    seconds: float


def two_stages(lab: Laboratory, method: Literal["idim-iv", "didim"], case: Case) -> TwoStages | None:
    """Identify the controller of a case, then the arm; ``None`` if the second stage does not converge.

    ``lab``: arm with its cached estimates; ``case``: filters and auxiliary simulation, with the kind of controller.
    """
    identified, took = lab.first_stage(case)
    try:
        run = lab.run(method, case)
    except DataError:
        return None
    return _in_figures(lab, identified, took, case, run) if run.estimate.converged else None


def structure_given(lab: Laboratory) -> TwoStages:
    """Identify the gains of a controller of known structure, then the arm by IDIM-IV."""
    recording = lab.recording(Case())
    robot, experiment = recording.robot, recording.experiment
    assert experiment.q_ref is not None
    ratios = robot.transmission_matrix
    begin = time.perf_counter()
    identified = identify_parametric(
        [experiment.q @ ratios.T],
        [experiment.q_ref @ ratios.T],
        [experiment.tau @ np.linalg.inv(ratios)],
        experiment.dt,
        structure=actual_structure(lab),
        saturation=saturation(robot),
    )
    took = time.perf_counter() - begin
    auxiliary = replace(lab.auxiliary(Case()), controller=identified.controller, asked=[])
    blocks = lab.equations(Case())
    begin = time.perf_counter()
    estimate = idim_iv(blocks, auxiliary, initial_parameters(lab.model))
    run = Run(estimate, np.nan, time.perf_counter() - begin, len(auxiliary.asked))
    found = _in_figures(lab, identified, took, Case(), run)
    return replace(
        found, loop_pct=relative_torque_errors(auxiliary.equations(blocks, estimate.theta), estimate.theta)[0]
    )


def actual_structure(lab: Laboratory) -> Structure:
    """Return the controller structure of the virtual drives: low-passed velocity of the arm or of the error."""
    feedback = bool(lab.recording(Case()).truth["velocity_feedback"])
    return Structure(velocity="position" if feedback else "error", filtered="velocity")


def gain_error(lab: Laboratory, identified: IdentifiedController) -> float | None:
    """Return the largest relative error of position and velocity gains, percent; ``None`` for impulse responses.

    ``lab``: virtual arm, with the true gains; ``identified``: identified controller of all motors.
    """
    recording = lab.recording(Case())
    errors = []
    for j, law in enumerate(identified.responses):
        if not isinstance(law, ControlLaw):
            return None
        kp, kv = (recording.truth[f"{name}{j + 1}"] for name in ("kp", "kv"))
        torque = kv * recording.robot.joints[j].drive.gain
        errors += [law.gains["kp"].value / kp - 1, law.gains["kv"].value / torque - 1]
    return 100 * float(np.abs(errors).max())


def _in_figures(lab: Laboratory, identified: IdentifiedController, took: float, case: Case, run: Run) -> TwoStages:
    try:
        loop = relative_torque_errors(lab.simulated(run, case), run.estimate.theta)[0]
    except DataError:
        loop = None
    std = lab.run("idim-iv", Case()).estimate.std
    return TwoStages(
        distance=lab.distance(run.estimate.theta, std),
        loop_pct=loop,
        gain_pct=gain_error(lab, identified),
        simulations=run.simulations,
        seconds=took + run.seconds,
    )
