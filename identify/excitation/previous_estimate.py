"""Parameters and noise of an earlier identification, for the design of the next experiment."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.terms import arm_model
from armident.identify.identification.checks.excitation import workspace_postures
from armident.identify.identification.checks.physics import impossible_values
from armident.identify.identification.equations import LS_CUTOFF
from armident.identify.identification.identification_criteria import IdentificationCriteria

FREQUENCIES = 4096
"""Number of frequencies of a noise spectrum."""


@dataclass(frozen=True)
class PreviousEstimate:
    """Earlier base parameters (b,) and torque noise (n,) below the cut-off of the regression, N m or N."""

    theta: Array
    noise: Array


def previous_estimate(document: IdentificationDocument, robot: RobotConfig, where: str) -> PreviousEstimate:
    """Return parameters and noise of an identification of the same robot; ``where`` names the document in errors.

    The noise is that of its noise models (thesis equation 6.19) below `LS_CUTOFF` times the closed-loop bandwidth,
    where the regression is made (2.3.1); without a configured bandwidth, all of it.
    """
    model = arm_model(robot)
    if document.robot != robot.name:
        raise DataError(f"{where}: the identification of robot {document.robot!r}, the configuration is {robot.name!r}")
    values = {p.name: p.value for p in document.parameters}
    if set(values) != set(model.base.names):
        odd = sorted(set(values) ^ set(model.base.names))
        raise DataError(f"{where}: other base parameters than the configuration of {robot.name}: {', '.join(odd[:5])}")
    found = document.noise_model
    if found.get("of") != "joint torque" or len(found.get("joints", [])) != robot.n:
        raise DataError(f"{where}: noise_model: expected one model of joint torques for each of {robot.n} joints")
    rate = float(found["rate_hz"])
    cutoff = min(LS_CUTOFF * robot.bandwidth_hz, rate / 2) if robot.bandwidth_hz is not None else rate / 2
    noise = [_deviation_below(cutoff, rate, joint["variance"], joint["coefficients"]) for joint in found["joints"]]
    return PreviousEstimate(np.array([values[name] for name in model.base.names]), np.array(noise))


def physical_estimate(document: IdentificationDocument, robot: RobotConfig, where: str) -> PreviousEstimate:
    """Return the estimate of `previous_estimate` with parameters that an arm can have: others predict wrong torques."""
    found = previous_estimate(document, robot, where)
    without = "Next: identify the arm from a better recording, or design without --known"
    if document.verdict == "unusable":
        reason = next((r.message for r in document.reasons if r.level == "unusable"), "no reason given")
        raise DataError(f"{where}: its verdict is unusable ({reason}). {without}")
    model, names = arm_model(robot), [p.name for p in document.parameters]
    if document.physical is not None:
        consistent = {base["name"]: base["value"] for base in document.physical["base"]}
        return replace(found, theta=np.array([consistent[name] for name in model.base.names]))
    order = [names.index(name) for name in model.base.names]
    covariance = np.asarray(document.covariance, dtype=np.float64)[np.ix_(order, order)]
    postures = workspace_postures(robot, np.zeros((1, robot.n)))
    faults = impossible_values(model, postures, found.theta, covariance, IdentificationCriteria())
    if faults:
        nearest = "take the nearest possible parameters (armident identify RECORDING --physical)"
        raise DataError(f"{where}: no arm has these parameters: {'; '.join(faults)}. {without}, or {nearest}")
    return found


def _deviation_below(cutoff_hz: float, rate_hz: float, variance: float, coefficients: list[float]) -> float:
    """Return the standard deviation of AR noise below a frequency: its spectrum is ``variance / |C|^2``."""
    f, response = signal.freqz([1.0], [1.0, *coefficients], worN=FREQUENCIES, fs=rate_hz)
    inside = f <= cutoff_hz
    share = float(np.mean(np.abs(response[inside]) ** 2)) * cutoff_hz / (rate_hz / 2)
    return float(np.sqrt(variance * share))
