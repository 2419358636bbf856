"""The problem that an estimator solves, its solution, and what the covariance of the solution neglects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.diagnostics import Diagnostics, diagnose_estimate
from armident.identify.estimators.methods import Method, estimator
from armident.identify.estimators.problem import JOINT_TORQUE
from armident.identify.estimators.reason import Reason
from armident.identify.estimators.residual_tests import ljung_box
from armident.identify.identification.equations import (
    LS_CUTOFF,
    PIV_CUTOFF,
    Prepared,
    decimated_rows,
    sufficient,
    tested,
)
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.options import Options
from armident.identify.identification.simulated_bias import (
    DOMINANT,
    FEW,
    SimulatedBias,
    corrected,
    simulated_bias,
)
from armident.identify.identification.torque_delay import TorqueDelay, torque_delay
from armident.identify.regression.equations import (
    Estimate,
    ExperimentEquations,
    joint_variances,
    noise_models,
    residuals_of,
)
from armident.identify.regression.iv import serial_covariance
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.streamed import chosen

NOT_FINITE = "infs or NaNs"
"""Text of scipy's ``ValueError`` for arrays that are not finite."""

FEW_LAGS = 5
"""Lags of the test for serial correlation: the correlation that widens intervals is that of near neighbours."""


def decimation_of(
    method: Method,
    dt: float,
    bandwidth_hz: float,
    factor: int | None,
    *,
    samples: Sequence[int] = (),
    rows: int = 0,
    warnings: list[str] | None = None,
    reasons: list[Reason] | None = None,
) -> Decimation:
    """Low-pass and decimation of a method, rough for one with a noise model; a chosen ``factor`` is kept."""
    share = PIV_CUTOFF if estimator(method).prefiltered else LS_CUTOFF
    cutoff = share * bandwidth_hz if factor is None else 0.5 / (dt * factor)
    wanted = design(dt, cutoff, factor)
    chosen = wanted if factor is not None else sufficient(wanted, dt, samples, rows)
    left = decimated_rows(chosen, samples)
    if left < rows and reasons is not None:
        message = (
            f"The decimation by {chosen.factor} leaves {left} equations per joint, fewer than {rows}: estimate and "
            "standard deviations are uncertain"
        )
        step = "record longer or decimate less" if chosen.factor > 1 else "record longer"
        reasons.append(Reason("doubtful", message, step, kind="uncertainty"))
    elif chosen is not wanted and warnings is not None:
        warnings.append(
            f"A cut-off of {cutoff:.3g} Hz leaves {decimated_rows(wanted, samples)} equations per joint, fewer than "
            f"{rows}: raised to {0.5 / (dt * chosen.factor):.3g} Hz, which leaves {left}."
        )
    return chosen


@dataclass(frozen=True)
class IdentificationProblem:
    """Input of every method: experiments, closed loop, first theta (b,); ``plain``: decimation without noise model."""

    prepared: Prepared
    auxiliary: AuxiliaryModel
    start: Array
    plain: Decimation
    options: Options

    @cached_property
    def blocks(self) -> Sequence[ExperimentEquations]:
        """Equations at measured signals with the decimation of the method."""
        return self.prepared.equations(self.auxiliary.decimation)

    @property
    def positions(self) -> Sequence[Array]:
        """Measured joint positions with the decimation of the method, one (M, n) array per experiment, rad or m."""
        return [self.auxiliary.decimation(e.q) for e in self.prepared.experiments]

    @property
    def max_ar_order(self) -> int:
        """Highest order of the noise models."""
        return self.options.max_ar_order

    @property
    def grey_box(self) -> bool:
        """True if the noise is that of the positions, through the controller (6.28)."""
        return self.options.noise_model == "grey-box"

    def bias(self, estimate: Estimate, *, prefiltered: bool) -> Array | None:
        """Bias (b,) of IDIM-IV or IDIM-PIV by derivatives and sampling alone; ``None``: no loop can be simulated."""
        found = self.simulated_bias(estimate, prefiltered=prefiltered, runs=FEW)
        return None if found is None else found.bias

    def simulated_bias(self, estimate: Estimate, *, prefiltered: bool, runs: int | None = None) -> SimulatedBias | None:
        """Bias of IDIM-IV or IDIM-PIV on simulated `tested` stretches; ``None`` if that is impossible."""
        numbers = tested(self.blocks)
        return simulated_bias(
            self.prepared.part(numbers),
            self.auxiliary.of_experiments(numbers),
            chosen(self.blocks, numbers),
            estimate,
            estimate.noise if prefiltered else joint_variances(self.blocks, estimate.theta),
            self.options.derivatives or "irwsm",
            runs=runs,
            share=len(numbers) / len(self.blocks),
        )

    @cached_property
    def plain_problem(self) -> "IdentificationProblem":
        """Problem with the decimation of the methods without a noise model."""
        return replace(self, auxiliary=replace(self.auxiliary.fresh(), decimation=self.plain))

    @cached_property
    def in_band(self) -> "IdentificationProblem":
        """Problem decimated to the band of the instruments, beyond which rows carry no information."""
        auxiliary = self.auxiliary
        if not auxiliary.limits_band:
            return self
        return replace(self, auxiliary=replace(auxiliary.fresh(), decimation=design(auxiliary.dt, auxiliary.band_hz)))


@dataclass(frozen=True)
class Solution:
    """Estimate with its problem and the bias (b,), SI, that was subtracted; ``prefiltered``: with weighted rows."""

    estimate: Estimate
    problem: IdentificationProblem
    prefiltered: bool = False
    noise_of: str = JOINT_TORQUE
    reasons: tuple[Reason, ...] = ()
    interval_warnings: tuple[str, ...] = ()
    bias: Array | None = None

    @cached_property
    def runs(self) -> Sequence[Simulation] | None:
        """Simulated closed loop with the estimate, one run per experiment; ``None`` if it diverges."""
        return self.problem.auxiliary.simulate(self.estimate.theta)

    @cached_property
    def motions(self) -> Sequence[Derivatives]:
        """Simulated motion along the references, without disturbances; raises DataError if it cannot be simulated."""
        auxiliary = self.problem.auxiliary.fresh()
        return auxiliary.motions(self.estimate.theta) if self.runs is None else auxiliary.motions_of(self.runs)

    @cached_property
    def instruments(self) -> Sequence[Array]:
        """Regressors at these motions, decimated to the band of the instruments, (M, n, b) per `tested` experiment."""
        problem = self.problem.in_band
        numbers, measured = tested(problem.blocks), estimator(problem.options.method).measured
        loop = problem.auxiliary.of_experiments(numbers)
        return list(loop.regressors(chosen(self.motions, numbers), thinned=measured))

    def diagnostics(self, essential: NDArray[np.bool_]) -> Diagnostics:
        """Tests of the estimate on its equations, decimated to the band of its instruments; see `tested`."""
        problem = self.problem.in_band
        numbers = tested(problem.blocks)
        estimate, instruments = residuals_of(self.estimate, numbers), self.instruments
        blocks, measured = [problem.blocks[k] for k in numbers], estimator(problem.options.method).measured
        if not measured:
            blocks = [replace(b, x=z) for b, z in zip(blocks, instruments, strict=True)]
        as_weighed = self.prefiltered and problem is self.problem
        weights = None if as_weighed else joint_variances(blocks, estimate.theta)
        return diagnose_estimate(
            problem.auxiliary.model.base.names,
            [joint.name for joint in problem.auxiliary.model.robot.joints],
            blocks,
            estimate,
            instruments=instruments if measured else None,
            weights=weights,
            essential=essential,
        )

    def delay(self) -> TorqueDelay | None:
        """Delay of the torques, with simulated motion as instruments; ``None`` if there is no finite solution."""
        problem, prepared = self.problem, self.problem.prepared
        blocks = prepared.equations(problem.plain)
        numbers = tested(blocks)
        x = [blocks[k].x for k in numbers]
        motions = chosen(self.motions, numbers)
        thinned = problem.in_band.auxiliary.decimation == problem.plain
        loop = problem.plain_problem.auxiliary.of_experiments(numbers)
        z = self.instruments if thinned else loop.regressors(motions, thinned=True)
        part = prepared.part(numbers)
        try:
            found = torque_delay(part.model, part.experiments, part.signals, problem.plain, motions, (x, z))
        except (np.linalg.LinAlgError, ValueError) as error:
            if not is_singular(error):
                raise
            return None
        return found if np.isfinite(found.samples).all() and np.isfinite(found.std).all() else None


def is_singular(error: Exception) -> bool:
    """Return true for a singular matrix, and for scipy's ``ValueError`` about numbers that are not finite."""
    return isinstance(error, np.linalg.LinAlgError) or NOT_FINITE in str(error)


def solve(problem: IdentificationProblem) -> Solution:
    """Solution of a problem by the method of its options, without the bias that instrumental variables have."""
    used = estimator(problem.options.method)
    assert used.solve is not None, f"{used.name} solves no problem with a closed loop"
    found = used.solve(problem)
    own = problem.plain_problem if found.plain else problem
    solution = Solution(found.estimate, own, found.prefiltered, found.noise_of, found.reasons)
    if found.noise_of != JOINT_TORQUE:
        return solution
    if used.measured:
        return _without_bias(solution)
    return solution if used.prefiltered else _doubted(solution)


def _without_bias(solution: Solution) -> Solution:
    """The solution without the bias by derivatives, encoder noise and sampling, where that is relevant."""
    problem, estimate = solution.problem, solution.estimate
    found = problem.simulated_bias(estimate, prefiltered=solution.prefiltered)
    if found is None:
        return solution
    worst, share = found.largest(estimate)
    if share <= IdentificationCriteria.max_bias_std:
        return solution
    name = problem.auxiliary.model.base.names[worst]
    line = (
        f"Derivatives, encoder noise and sampling bias the estimate ({name} by {share:.1f} std on simulated "
        "recordings). The bias was subtracted, but intervals are doubtful. Next: a higher sampling rate, a finer "
        "encoder or slower accelerations."
    )
    doubtful = (line,) if share > DOMINANT else ()
    return replace(
        solution,
        estimate=corrected(estimate, found, problem.blocks),
        interval_warnings=(*solution.interval_warnings, *doubtful),
        bias=found.bias,
    )


def _doubted(solution: Solution) -> Solution:
    """The solution with a warning where serial correlation, which 2.37 neglects, makes its intervals too narrow."""
    problem, estimate = solution.problem, solution.estimate
    simulated = problem.auxiliary.fresh().equations(problem.blocks, estimate.theta)
    noise = noise_models(simulated, estimate.theta, estimate.covariance, problem.options.max_ar_order)
    zeta, keep = [b.x for b in simulated], [b.keep for b in simulated]
    covariance = serial_covariance(zeta, zeta, keep, joint_variances(simulated, estimate.theta), noise)
    names = problem.auxiliary.model.base.names
    method = problem.options.method.upper()
    doubts = doubts_of_serial_correlation(method, names, estimate, np.sqrt(np.diag(covariance)))
    return replace(solution, interval_warnings=(*solution.interval_warnings, *doubts))


def doubts_of_serial_correlation(method: str, names: Sequence[str], estimate: Estimate, std: Array) -> tuple[str, ...]:
    """Warning if the residuals of a joint are not white (Ljung and Box 1978), and intervals too narrow for ``std``."""
    ratio = std / estimate.std
    worst = int(np.argmax(ratio))
    white = all(ljung_box(series, FEW_LAGS)[2] >= IdentificationCriteria.serial_level for series in estimate.residuals)
    if white or ratio[worst] <= IdentificationCriteria.max_serial_std_ratio:
        return ()
    return (
        f"The residuals of {method} are serially correlated, which its covariance neglects (the std of {names[worst]} "
        f"would be {ratio[worst]:.1f} times as large): its intervals are doubtful. Next: IDIM-IV or IDIM-PIV.",
    )
