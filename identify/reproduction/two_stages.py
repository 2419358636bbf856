"""First the controller, then the arm: what the approaches of tables 5.3 and 5.4 come to in numbers (section 5.2.1)."""

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from configs import DataError
from identify.closed_loop import initial_parameters
from identify.controller.crc import IdentifiedController
from identify.controller.law import Structure
from identify.controller.nominal import saturation
from identify.controller.parametric import ControlLaw, identify_parametric
from identify.estimators.didim import didim
from identify.estimators.idim_iv import idim_iv
from identify.reproduction.laboratory import Case, Laboratory, identify_controller
from identify.result import relative_errors

First = Literal["parametric", "parametric, structure given", "crc"]
Second = Literal["idim-iv", "didim"]

ACTUAL_STRUCTURE = Structure(velocity="error", filtered="velocity")
"""Of the virtual arm's drives: a PD on the tracking error, its derivative through a first-order low-pass (B.3)."""


@dataclass(frozen=True)
class TwoStages:
    """What a controller, then an arm, identified from one recording come to.

    Parameters
    ----------
    distance
        Of the parameters from the virtual arm's own, root mean square in standard deviations of IDIM-IV beside the
        actual controller; about 1 where the controller is as good as the actual one.
    loop_pct
        Relative error of the torques that identified controller and identified arm give together, in simulation along
        the recorded reference.
    gain_pct
        Largest relative error of a drive's gains; ``None`` where the controller has none.
    simulations, seconds
        Closed-loop simulations, and time with both stages, filters apart.
    """

    distance: float
    loop_pct: float
    gain_pct: float | None
    simulations: int
    seconds: float


def two_stages(lab: Laboratory, first: First, second: Second) -> TwoStages | None:
    """Identify the controller, then the arm beside it; ``None`` where the second stage does not converge."""
    return lab.once(("two stages", first, second), lambda: _two_stages(lab, first, second))


def controller_of(lab: Laboratory, first: First) -> tuple[IdentifiedController, float]:
    """The controller of the first stage, and the seconds that it took."""

    def identified() -> tuple[IdentifiedController, float]:
        recording = lab.recording(Case())
        begin = time.perf_counter()
        if first != "parametric, structure given":
            return identify_controller(recording, first), time.perf_counter() - begin
        robot, experiment = recording.robot, recording.experiment
        assert experiment.q_ref is not None
        ratios = robot.transmission_matrix
        found = identify_parametric(
            [experiment.q @ ratios.T],
            [experiment.q_ref @ ratios.T],
            [experiment.tau @ np.linalg.inv(ratios)],
            experiment.dt,
            structure=ACTUAL_STRUCTURE,
            saturation=saturation(robot),
        )
        return found, time.perf_counter() - begin

    return lab.once(("first stage", first), identified)


def _two_stages(lab: Laboratory, first: First, second: Second) -> TwoStages | None:
    identified, took = controller_of(lab, first)
    auxiliary = replace(lab.auxiliary(Case()), controller=identified.controller, asked=[])
    blocks = lab.equations(Case())
    begin = time.perf_counter()
    try:
        method = idim_iv if second == "idim-iv" else didim
        estimate = method(blocks, auxiliary, initial_parameters(lab.model))
    except DataError:
        return None
    seconds = took + time.perf_counter() - begin
    if not estimate.converged:
        return None
    std = lab.run("idim-iv", Case()).estimate.std
    simulated = auxiliary.equations(blocks, estimate.theta)
    return TwoStages(
        distance=lab.distance(estimate.theta, std),
        loop_pct=relative_errors(simulated, estimate.theta)[0],
        gain_pct=gain_error(lab, identified),
        simulations=len(auxiliary.asked),
        seconds=seconds,
    )


def gain_error(lab: Laboratory, identified: IdentifiedController) -> float | None:
    """Largest relative error, %, of position and velocity gains; ``None`` for impulse responses."""
    recording = lab.recording(Case())
    errors = []
    for j, law in enumerate(identified.responses):
        if not isinstance(law, ControlLaw):
            return None
        true_kp, true_kv = (recording.truth[f"{name}{j + 1}"] for name in ("kp", "kv"))
        kv = true_kv * recording.robot.joints[j].drive.gain
        errors += [law.gains["kp"].value / true_kp - 1, law.gains["kv"].value / kv - 1]
    return 100 * float(np.abs(errors).max())
