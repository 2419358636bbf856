"""The document ``identification.json``."""

import math
from typing import Any, Literal

from pydantic import Field

from armident.identify.documents.base import Document, RecordingReference, SignedDocument


class Parameter(Document):
    """One estimated parameter, SI.

    Parameters
    ----------
    name
        Name of the base parameter, for example ``zz1r``.
    value
        Estimate.
    std
        Standard deviation of the estimate.
    relative_std_pct
        Standard deviation in percent of the value; null where the value is zero. Up to 5 %: well determined; up to
        20 %: usable.
    unit
        Unit of value and standard deviation.
    essential
        True for a parameter that the data need. The others are removed one by one, the largest relative standard
        deviation first, while an F-test does not reject this (level 1 %; thesis appendix B.2).
    formula
        Standard parameters that a base parameter groups, for example ``my5 - mz6``.
    """

    name: str
    value: float
    std: float
    relative_std_pct: float | None
    unit: str
    essential: bool
    formula: str | None = None


def parameter(name: str, value: float, std: float, unit: str, essential: bool, formula: str | None = None) -> Parameter:
    """Return one parameter with its relative standard deviation in percent, null where that is not finite.

    Parameters
    ----------
    name, value, std, unit
        As in the document, SI.
    essential
        True for an essential parameter.
    formula
        Standard parameters that it groups.
    """
    relative = 100.0 * float(std) / abs(float(value)) if value != 0.0 else None
    if relative is not None and not math.isfinite(relative):
        relative = None
    return Parameter(
        name=name,
        value=float(value),
        std=float(std),
        relative_std_pct=relative,
        unit=unit,
        essential=essential,
        formula=formula,
    )


class Whiteness(Document):
    """Residual autocorrelation of a joint.

    Parameters
    ----------
    joint
        Name of the joint.
    lags
        Number of lags that are tested.
    fraction_outside_2sigma
        Fraction of the lags outside two standard deviations; 0.05 for white residuals.
    """

    joint: str
    lags: int
    fraction_outside_2sigma: float


class ResidualStatistics(Document):
    """Statistics of the residuals of a joint, for the comparison with a later run of the same motion.

    Parameters
    ----------
    joint
        Name of the joint.
    position_range
        Lowest and highest position of the free functions, rad or m.
    velocity_limit
        Largest absolute velocity of the free functions, rad/s or m/s.
    score
        Score of the coefficients of free functions of position (two thirds of them) and of velocity.
    information
        Information matrix of these coefficients, estimated beside all parameters.
    band_edges_hz
        Edges of the frequency bands, Hz.
    band_power
        Mean square of the residuals between two edges, (N m)^2 or N^2.
    band_degrees
        Degrees of freedom of each band power.
    """

    joint: str
    position_range: tuple[float, float]
    velocity_limit: float
    score: list[float]
    information: list[list[float]]
    band_edges_hz: list[float]
    band_power: list[float]
    band_degrees: list[float]


class ChangeDirection(Document):
    """Change of the estimate by an effect that the model lacks, per unit of each of its linear parameters.

    Parameters
    ----------
    effect
        Name of the effect in the catalogue.
    joint
        Name of its joint; of an effect of the whole arm, of the first one.
    parameters
        Change of the parameters, for each linear parameter of the effect.
    scores
        Change of the ``score`` of the residual statistics of each joint, for each linear parameter.
    """

    effect: str
    joint: str
    parameters: list[list[float]]
    scores: list[list[list[float]]]


class VerdictReason(Document):
    """Defect of an identification.

    Parameters
    ----------
    level
        Verdict that the defect causes.
    kind
        Property that is judged, for example ``convergence`` or ``negative_friction``.
    joint
        Joint with the defect; null if it belongs to the whole robot.
    message
        Defect in one sentence.
    next_step
        Remedy in one sentence.
    """

    level: Literal["doubtful", "unusable"]
    kind: str
    joint: str | None
    message: str
    next_step: str


class Comparison(Document):
    """Estimate of a simpler method from the same data, for comparison.

    Parameters
    ----------
    method
        Name of the method.
    parameters
        Its estimates.
    relative_error_pct
        Its relative torque error, percent.
    """

    method: str
    parameters: list[Parameter]
    relative_error_pct: float | None = None


class IdentificationDocument(SignedDocument):
    """Content of ``identification.json``: estimated parameters, their covariance, the data, method and diagnostics.

    Parameters
    ----------
    verdict
        Usability of the parameters by the limits in ``criteria``; null in documents of former versions.
    reasons
        Defects behind the verdict; empty for a trustworthy one.
    recording
        Recording that was identified.
    method
        Estimator.
    options
        Options of the identification.
    parameters
        Estimated base parameters.
    covariance
        Covariance matrix of the parameters, in their order.
    relative_error_pct
        Norm of the torque error over the norm of the measured torque, percent.
    relative_error_pct_by_joint
        The same of each joint, percent. Above a third, the model does not describe it.
    iterations
        Number of iterations.
    converged
        True if the iterations converged.
    stop_reason
        Reason for which the iterations ended.
    whiteness
        Residual autocorrelation of each joint. More than 5 % of the lags outside two standard deviations mean that the
        residual contains model error, and that standard deviations may be too small.
    noise_model
        Autoregressive model of each joint's torque noise, of an order chosen by Akaike's criterion; its inverse filters
        the regression (thesis equation 6.19).
    controller
        Response of each drive from position error to torque, which closes the simulated loop. CRC: impulse response by
        correlation analysis; parametric: cascade or PID gains; known: as configured.
    timing_s
        Time of each step, s.
    warnings
        Messages of conversion and estimation.
    comparison
        IDIM-LS estimate from the same data; null if the method is IDIM-LS.
    diagnostics
        Statistical tests of the estimate, with p-values.
    physical
        Nearest physically consistent parameters, where they were asked for.
    torque_delay_samples
        Number of samples by which the torque of each joint leads the position, and its standard
        deviation. A drive that reports the torque that it holds until the next sample has a lead of 0.5.
    further_recordings
        Further recordings that were identified together with the first one.
    bias
        Bias by derivatives, encoder noise and sampling that was subtracted from each parameter; null where it is
        irrelevant.
    sign_smoothing
        ``g`` of each joint's ``sign(qd) -> (2/pi) atan(g qd)``, s/rad or s/m.
    transitions
        Velocity ``1/g`` over which dry friction of a joint reverses, and the limits of its 95 % interval, rad/s or m/s,
        where the torques determine it.
    criteria
        Limits of the verdict.
    residual_statistics
        Statistics of the residuals for later comparison; null in documents of former versions.
    change_directions
        Changes of the estimate by effects that a later comparison may find; null in documents of former versions.
    configuration
        Robot configuration that the parameters belong to; null in documents of former versions.
    held_out_error_pct
        Torque error where each fifth of the recordings is predicted by least squares from the rest, percent; null where
        the rest does not determine the parameters, and in documents of former versions.
    held_out_error_pct_by_joint
        The same of each joint, percent.
    """

    schema_: Literal["armident/identification/1"] = Field("armident/identification/1", alias="schema")
    verdict: Literal["trustworthy", "doubtful", "unusable"] | None = None
    reasons: list[VerdictReason] = Field(default_factory=list)
    robot: str
    recording: RecordingReference
    method: str
    options: dict[str, Any]
    parameters: list[Parameter]
    covariance: list[list[float]]
    relative_error_pct: float
    relative_error_pct_by_joint: dict[str, float]
    iterations: int
    converged: bool
    stop_reason: str
    whiteness: list[Whiteness]
    noise_model: dict[str, Any]
    controller: dict[str, Any]
    timing_s: dict[str, float]
    versions: dict[str, str]
    warnings: list[str]
    comparison: Comparison | None = None
    diagnostics: dict[str, Any] | None = None
    physical: dict[str, Any] | None = None
    torque_delay_samples: dict[str, list[float]] | None = None
    further_recordings: list[RecordingReference] | None = None
    bias: dict[str, float] | None = None
    sign_smoothing: dict[str, float] | None = None
    transitions: dict[str, tuple[float, float, float]] | None = None
    criteria: dict[str, float] | None = None
    residual_statistics: list[ResidualStatistics] | None = None
    change_directions: list[ChangeDirection] | None = None
    configuration: dict[str, Any] | None = None
    held_out_error_pct: float | None = None
    held_out_error_pct_by_joint: dict[str, float] | None = None

    @property
    def transition_sentence(self) -> str:
        """Velocities over which dry friction reverses, with their intervals; empty if the torques determine none."""
        joints = {} if self.configuration is None else {joint["name"]: joint for joint in self.configuration["joints"]}
        found = []
        for joint, (velocity, low, high) in (self.transitions or {}).items():
            unit = "mm/s" if joints.get(joint, {}).get("type") == "prismatic" else "mrad/s"
            found.append(f"{joint} {1e3 * velocity:.3g} ({1e3 * low:.3g} to {1e3 * high:.3g}) {unit}")
        return f"Dry friction reverses over a velocity of: {', '.join(found)} (95 % intervals)." if found else ""

    @property
    def sentence(self) -> str:
        """Verdict and, if not trustworthy, its first reason."""
        level = self.verdict or "not judged"
        if not self.reasons:
            return level
        more = len(self.reasons) - 1
        return f"{level}: {self.reasons[0].message}" + (f" (and {more} more)" if more else "")
