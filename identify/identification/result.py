"""The result of an identification, and how it is put together."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.estimators.diagnostics import Diagnostics
from armident.identify.identification.options import Options
from armident.identify.identification.torque_delay import TorqueDelay
from armident.identify.regression.ar_noise import whiteness
from armident.identify.regression.equations import Estimate, ExperimentEquations, residuals
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.consistent import ConsistentParameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JointWhiteness:
    """Residual autocorrelation of one joint: share of the lags outside the 2-sigma band (about 0.05 if white)."""

    joint: str
    lags: int
    fraction_outside_2sigma: float


@dataclass(frozen=True)
class Identification:
    """The result of an identification; SI, joint side.

    Parameters
    ----------
    names, units, formulas, theta, std, covariance, essential
        Base parameters (b,), the formulas of those that stand for several, their covariance (b, b), and which of them
        the data need.
    diagnostics
        Tests of the estimate.
    physical
        The nearest physically consistent arm, where it was asked for.
    delay
        Of the recorded torques against the positions, where a reference trajectory was recorded.
    relative_error_pct, relative_error_pct_by_joint
        ``|y - X theta| / |y|`` on the torques decimated to twice the bandwidth, overall and (n,).
    whiteness, residual_autocorrelation, autocorrelation_bound
        Of the residuals that the estimator weighs: test, (n, lags), and 2 sigma (n,).
    idim_ls
        Theta and standard deviations of IDIM-LS on the same data, for comparison.
    t, tau_measured, tau_predicted
        Decimated instants (M,) and torques (M, n), experiments one after the other.
    """

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
    idim_ls_relative_error_pct: float
    t: Array
    tau_measured: Array
    tau_predicted: Array
    residual_autocorrelation: Array
    autocorrelation_bound: Array


def make_result(
    options: Options,
    model: ArmModel,
    estimate: Estimate,
    essential: NDArray[np.bool_],
    diagnostics: Diagnostics,
    physical: ConsistentParameters | None,
    delay: TorqueDelay | None,
    blocks: Sequence[ExperimentEquations],
    ls: Estimate,
    ls_blocks: Sequence[ExperimentEquations],
    controller: dict[str, Any],
    noise_of: str,
    warnings: Sequence[str],
    timing_s: dict[str, float],
) -> Identification:
    """Put a result together: statistics of the estimate and its errors on the least-squares equations."""
    joints = [joint.name for joint in model.robot.joints]
    overall, by_joint = relative_errors(ls_blocks, estimate.theta)
    tests = [whiteness(series) for series in estimate.residuals]
    return Identification(
        method=options.method,
        names=model.base.names,
        formulas={name: formula for name, formula in model.base.formulas.items() if formula != name},
        units=units(model),
        theta=estimate.theta,
        covariance=estimate.covariance,
        std=estimate.std,
        essential=essential,
        diagnostics=diagnostics,
        physical=physical,
        delay=delay,
        relative_error_pct=overall,
        relative_error_pct_by_joint=by_joint,
        iterations=estimate.iterations,
        converged=estimate.converged,
        stop_reason=estimate.stop_reason,
        whiteness=tuple(
            JointWhiteness(name, test.lags, test.fraction_outside) for name, test in zip(joints, tests, strict=True)
        ),
        noise_model={
            "of": noise_of,
            "rate_hz": float(1 / (blocks[0].t[1] - blocks[0].t[0])),
            "joints": [
                {"joint": name, "order": ar.order, "variance": ar.variance, "coefficients": ar.coefficients.tolist()}
                for name, ar in zip(joints, estimate.noise, strict=True)
            ],
        },
        controller=controller,
        timing_s=timing_s,
        warnings=tuple(dict.fromkeys(warnings)),
        options=options,
        idim_ls=(ls.theta, ls.std),
        idim_ls_relative_error_pct=relative_errors(ls_blocks, ls.theta)[0],
        t=np.concatenate([b.t for b in ls_blocks]),
        tau_measured=np.concatenate([b.y for b in ls_blocks]),
        tau_predicted=np.concatenate([b.x @ estimate.theta for b in ls_blocks]),
        residual_autocorrelation=np.stack([test.autocorrelation for test in tests]),
        autocorrelation_bound=np.array([test.bound for test in tests]),
    )


def relative_errors(blocks: Sequence[ExperimentEquations], theta: Array) -> tuple[float, Array]:
    """``|y - X theta| / |y|`` in percent, overall and per joint (n,)."""
    errors = residuals(blocks, theta)
    miss = sum(np.sum(np.where(b.keep, e, 0.0) ** 2, axis=0) for e, b in zip(errors, blocks, strict=True))
    power = sum(np.sum(np.where(b.keep, b.y, 0.0) ** 2, axis=0) for b in blocks)
    return 100 * float(np.sqrt(np.sum(miss) / np.sum(power))), 100 * np.sqrt(miss / np.maximum(power, 1e-300))


def units(model: ArmModel) -> tuple[str, ...]:
    """SI units of the base parameters, those of the terms at the end, (b,)."""
    rigid = [unit(name, model.robot) for name in model.base.names[: model.base.b - model.e]]
    return (*rigid, *(one for term in model.terms for one in term.units))


UNITS = {"ia": ("kg m^2", "kg"), "fv": ("N m s/rad", "N s/m"), "fc": ("N m", "N"), "of": ("N m", "N")}
"""Of friction, offset and rotor inertia of a revolute and of a prismatic joint, by the first two letters."""


def unit(name: str, robot: RobotConfig) -> str:
    """SI unit of a base parameter, joint side."""
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
