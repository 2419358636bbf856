"""The result of an identification, and its assembly."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.estimators.diagnostics import Diagnostics
from armident.identify.identification.equations import Prepared
from armident.identify.identification.held_out import held_out_errors
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.options import Options
from armident.identify.identification.residual_statistics import EffectDirection, JointResidualStatistics
from armident.identify.identification.sign_smoothing import Transition
from armident.identify.identification.torque_delay import TorqueDelay
from armident.identify.identification.verdict import Verdict
from armident.identify.regression.ar_noise import whiteness
from armident.identify.regression.equations import Estimate, ExperimentEquations, residuals
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.consistent import ConsistentParameters
from armident.identify.signals.decimate import Decimation

WORTHLESS_PCT = 100.0
"""Relative torque error, percent, of parameters that are all zero."""


@dataclass(frozen=True)
class JointWhiteness:
    """Residual autocorrelation of one joint: share of the lags outside the 2-sigma band, about 0.05 if white."""

    joint: str
    lags: int
    fraction_outside_2sigma: float


@dataclass(frozen=True)
class IdentificationResult:
    """The result of an identification; SI, joint side.

    ``theta``, ``std``, ``essential`` (b,) and ``covariance`` (b, b) belong to the base parameters; ``formulas`` are of
    regrouped ones. ``relative_error_pct`` is ``|y - X theta| / |y|`` on torques decimated to twice the bandwidth,
    overall and by joint (n,). ``bias`` (b,) was subtracted; ``None``: irrelevant. ``sign_smoothing`` is ``g`` (n,),
    s/rad or s/m. ``converged`` requires that the parameters explain torques better than none. ``held_out`` is ``None``
    if the rest does not determine the parameters. ``t`` (M,), s, and the torques (M, n), N m or N, are decimated
    instants of one experiment after the other, of ``equations``, made from ``prepared``.
    """

    verdict: Verdict
    criteria: IdentificationCriteria
    method: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    formulas: dict[str, str]
    theta: Array
    covariance: Array
    std: Array
    essential: NDArray[np.bool_]
    diagnostics: Diagnostics
    physical: ConsistentParameters | None
    delay: TorqueDelay | None
    sign_smoothing: Array
    interval_warnings: tuple[str, ...]
    bias: Array | None
    relative_error_pct: float
    relative_error_pct_by_joint: Array
    iterations: int
    converged: bool
    stop_reason: str
    whiteness: tuple[JointWhiteness, ...]
    noise_model: dict[str, Any]
    controller: dict[str, Any]
    timing_s: dict[str, float]
    warnings: tuple[str, ...]
    options: Options
    idim_ls: tuple[Array, Array]
    t: Array
    tau_measured: Array
    tau_predicted: Array
    residual_autocorrelation: Array
    autocorrelation_bound: Array
    residual_statistics: tuple[JointResidualStatistics, ...] = ()
    transitions: Mapping[str, Transition] = field(default_factory=dict)
    change_directions: tuple[EffectDirection, ...] = ()
    equations: Sequence[ExperimentEquations] = ()
    prepared: Prepared | None = None
    held_out: tuple[float, Array] | None = None


@dataclass(frozen=True)
class LeastSquares:
    """The IDIM-LS estimate and its equations; ``factor``: decimation chosen by the user or from the noise."""

    estimate: Estimate
    blocks: Sequence[ExperimentEquations]
    decimation: Decimation
    factor: int | None
    published: bool = False


@dataclass(frozen=True)
class MethodResult:
    """Estimate of the chosen method; ``noise_of``: quantity of its residuals. IDIM-LS: controller of kind ``none``."""

    estimate: Estimate
    blocks: Sequence[ExperimentEquations]
    controller: dict[str, Any]
    noise_of: str = "joint torque"


@dataclass(frozen=True)
class Statistics:
    """Tests of an estimate; ``essential`` (b,) is a mask, ``bias`` (b,), SI, was subtracted; ``None``: irrelevant."""

    essential: NDArray[np.bool_]
    diagnostics: Diagnostics
    delay: TorqueDelay | None = None
    physical: ConsistentParameters | None = None
    interval_warnings: tuple[str, ...] = ()
    bias: Array | None = None
    residuals: tuple[JointResidualStatistics, ...] = ()
    transitions: Mapping[str, Transition] = field(default_factory=dict)
    changes: tuple[EffectDirection, ...] = ()


def make_result(
    options: Options,
    prepared: Prepared,
    found: MethodResult,
    ls: LeastSquares,
    statistics: Statistics,
    judged: tuple[Verdict, IdentificationCriteria],
    warnings: Sequence[str],
    timing_s: dict[str, float],
) -> IdentificationResult:
    """Assemble the result; relative errors are those on the equations of IDIM-LS, and each warning is kept once."""
    model, estimate, ls_blocks = prepared.model, found.estimate, ls.blocks
    joints = [joint.name for joint in model.robot.joints]
    overall, by_joint = relative_torque_errors(ls_blocks, estimate.theta)
    tests = [whiteness(series) for series in estimate.residuals]
    converged, stop_reason = estimate.converged, estimate.stop_reason
    if converged and not overall < WORTHLESS_PCT:
        converged, stop_reason = False, f"the parameters explain less than none: torque error {overall:.3g} %"
    return IdentificationResult(
        verdict=judged[0],
        criteria=judged[1],
        method=options.method,
        names=model.base.names,
        formulas={name: formula for name, formula in model.base.formulas.items() if formula != name},
        units=units(model),
        theta=estimate.theta,
        covariance=estimate.covariance,
        std=estimate.std,
        essential=statistics.essential,
        diagnostics=statistics.diagnostics,
        physical=statistics.physical,
        delay=statistics.delay,
        sign_smoothing=model.smoothing,
        interval_warnings=statistics.interval_warnings,
        bias=statistics.bias,
        relative_error_pct=overall,
        relative_error_pct_by_joint=by_joint,
        iterations=estimate.iterations,
        converged=converged,
        stop_reason=stop_reason,
        whiteness=tuple(
            JointWhiteness(name, test.lags, test.fraction_outside) for name, test in zip(joints, tests, strict=True)
        ),
        noise_model={
            "of": found.noise_of,
            "rate_hz": float(1 / (found.blocks[0].t[1] - found.blocks[0].t[0])),
            "joints": [
                {"joint": name, "order": ar.order, "variance": ar.variance, "coefficients": ar.coefficients.tolist()}
                for name, ar in zip(joints, estimate.noise, strict=True)
            ],
        },
        controller=found.controller,
        timing_s=timing_s,
        warnings=tuple(dict.fromkeys(warnings)),
        options=options,
        idim_ls=(ls.estimate.theta, ls.estimate.std),
        t=np.concatenate([b.t for b in ls_blocks]),
        tau_measured=np.concatenate([b.y for b in ls_blocks]),
        tau_predicted=np.concatenate([b.x @ estimate.theta for b in ls_blocks]),
        residual_autocorrelation=np.stack([test.autocorrelation for test in tests]),
        autocorrelation_bound=np.array([test.bound for test in tests]),
        residual_statistics=statistics.residuals,
        transitions=statistics.transitions,
        change_directions=statistics.changes,
        equations=ls_blocks,
        prepared=prepared,
        held_out=held_out_errors(ls_blocks, estimate.theta),
    )


def relative_torque_errors(blocks: Sequence[ExperimentEquations], theta: Array) -> tuple[float, Array]:
    """``|y - X theta| / |y|`` in percent, overall and per joint (n,)."""
    errors = residuals(blocks, theta)
    miss = sum(np.sum(np.where(b.keep, e, 0.0) ** 2, axis=0) for e, b in zip(errors, blocks, strict=True))
    power = sum(np.sum(np.where(b.keep, b.y, 0.0) ** 2, axis=0) for b in blocks)
    return 100 * float(np.sqrt(np.sum(miss) / max(float(np.sum(power)), 1e-300))), 100 * np.sqrt(
        miss / np.maximum(power, 1e-300)
    )


def units(model: ArmModel) -> tuple[str, ...]:
    """SI units of the base parameters, those of the terms at the end, shape (b,)."""
    rigid = [unit(name, model.robot) for name in model.base.names[: model.base.b - model.e]]
    return (*rigid, *(one for term in model.terms for one in term.units))


UNITS = {"ia": ("kg m^2", "kg"), "fv": ("N m s/rad", "N s/m"), "fc": ("N m", "N"), "of": ("N m", "N")}
"""SI units at a revolute and at a prismatic joint, by the first two letters of the parameter's name."""


def unit(name: str, robot: RobotConfig) -> str:
    """SI unit of a base parameter, joint side, whose joints are revolute or prismatic."""
    kind = name[:2]
    if kind in ("mx", "my", "mz"):
        return "kg m"
    if kind in ("xx", "xy", "xz", "yy", "yz", "zz"):
        return "kg m^2"
    if kind not in UNITS:
        return "kg"
    coupled = {c.name: c.joints[0] for c in robot.couplings}
    joints = {str(k): joint for k, joint in enumerate(robot.joints, start=1)}
    joints |= {c: joint for c, first in coupled.items() for joint in robot.joints if joint.name == first}
    joint = joints.get(name.removeprefix("off").removeprefix(kind).removesuffix("r"))
    return UNITS[kind][joint is not None and joint.type == "prismatic"]
