"""Equations and estimator of every identification method, by name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.clie import clie
from armident.identify.estimators.cloe import cloe
from armident.identify.estimators.diagnostics import Diagnostics, diagnose_estimate
from armident.identify.estimators.didim import didim
from armident.identify.estimators.idim_iv import idim_iv
from armident.identify.estimators.idim_piv import idim_piv
from armident.identify.estimators.sep_pem import sep_pem
from armident.identify.identification.equations import (
    LS_CUTOFF,
    PIV_CUTOFF,
    Prepared,
    decimated_rows,
    sufficient,
    tested,
)
from armident.identify.identification.interval_doubts import doubts_of_serial_correlation
from armident.identify.identification.options import Method, Options
from armident.identify.identification.simulated_bias import (
    DOMINANT,
    FEW,
    RELEVANT_BIAS,
    SimulatedBias,
    corrected,
    simulated_bias,
)
from armident.identify.identification.torque_delay import TorqueDelay, torque_delay
from armident.identify.identification.verdict import Reason
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
from armident.identify.streamed import chosen

CONTRADICTION = 5.0
"""Standard deviations by which IDIM-PIV may differ from IDIM-IV in any parameter before IDIM-IV replaces it."""

CONTRADICTION_CAUSE = "they contain errors of the model or its derivatives"
NO_REFERENCE_CAUSE = f"{CONTRADICTION_CAUSE}, or the instruments, which follow the measured motion, share their noise"
"""Causes of a contradiction between IDIM-PIV and IDIM-IV, with instruments from a recorded reference and without."""

NOT_FINITE = "infs or NaNs"
"""Text of scipy's ``ValueError`` for arrays that are not finite."""

PREFILTERED: tuple[Method, ...] = ("idim-piv", "sep-pem")
"""Methods with a noise model: their equations are decimated only roughly (thesis section 7.2)."""

MEASURED: tuple[Method, ...] = ("idim-ls", "idim-iv", "idim-piv")
"""Methods whose regressor is the measured one."""

Array = NDArray[np.float64]


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
    """Return low-pass and decimation for a method; enough equations are left unless the user chose the factor.

    Parameters
    ----------
    method
        Name of the method; those with a noise model decimate only roughly.
    bandwidth_hz
        Closed-loop bandwidth, Hz.
    factor
        Factor chosen by the user, kept even if too few equations are left; ``None``: from the bandwidth.
    samples
        Length of every experiment.
    rows
        Least number of instants of all experiments together, see `least_rows`.
    warnings
        List to which a line is added if the cut-off was raised.
    reasons
        List to which a reason of the verdict is added if too few equations are left.
    """
    share = PIV_CUTOFF if method in PREFILTERED else LS_CUTOFF
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
class Problem:
    """Input of every method: experiments with derivatives, the closed loop, and the first iterate.

    ``prepared``: arm, experiments and derivatives; ``auxiliary``: the simulated closed loop with the decimation of the
    method; ``start``: first theta, shape (b,); ``plain``: decimation of the methods without a noise model.
    """

    prepared: Prepared
    auxiliary: AuxiliaryModel
    start: Array
    plain: Decimation
    options: Options

    @cached_property
    def blocks(self) -> Sequence[ExperimentEquations]:
        """Equations at measured signals with the decimation of the method."""
        return self.prepared.equations(self.auxiliary.decimation)

    @cached_property
    def plain_problem(self) -> "Problem":
        """Problem with the decimation of the methods without a noise model."""
        return replace(self, auxiliary=replace(self.auxiliary.fresh(), decimation=self.plain))

    @cached_property
    def in_band(self) -> "Problem":
        """Problem decimated to the band of the instruments where the equations have a wider one.

        At the recorded rate nearly all rows lie beyond the band of the instruments and carry no information.
        """
        auxiliary = self.auxiliary
        if not auxiliary.limits_band:
            return self
        return replace(self, auxiliary=replace(auxiliary.fresh(), decimation=design(auxiliary.dt, auxiliary.band_hz)))


@dataclass(frozen=True)
class Solution:
    """Estimate with the problem that it solves.

    Parameters
    ----------
    estimate, problem
        Estimate, and the equations to which it belongs.
    prefiltered
        True if the noise models weighted the rows; false if they only entered the covariance.
    noise_of
        Quantity to which noise models and residuals belong.
    reasons
        Defects for the verdict.
    interval_warnings
        Reasons why the standard deviations are doubtful.
    bias
        Bias (b,) that was subtracted, SI; ``None``: irrelevant.
    """

    estimate: Estimate
    problem: Problem
    prefiltered: bool = False
    noise_of: str = "joint torque"
    reasons: tuple[Reason, ...] = ()
    interval_warnings: tuple[str, ...] = ()
    bias: Array | None = None

    @cached_property
    def runs(self) -> Sequence[Simulation] | None:
        """Simulated closed loop with the estimate, one run per experiment; ``None`` if it diverges."""
        return self.problem.auxiliary.simulate(self.estimate.theta)

    @cached_property
    def motions(self) -> Sequence[Derivatives]:
        """Simulated motion of the estimate along the recorded references, without the disturbances of the recordings.

        Raises DataError if neither the estimate nor any point between it and the last good one can be simulated.
        """
        auxiliary = self.problem.auxiliary.fresh()
        return auxiliary.motions(self.estimate.theta) if self.runs is None else auxiliary.motions_of(self.runs)

    @cached_property
    def instruments(self) -> Sequence[Array]:
        """Regressors at these motions, decimated to the band of the instruments, (M, n, b) per `tested` experiment."""
        problem = self.problem.in_band
        numbers = tested(problem.blocks)
        return list(problem.auxiliary.of_experiments(numbers).regressors(chosen(self.motions, numbers)))

    def diagnostics(self, essential: NDArray[np.bool_]) -> Diagnostics:
        """Tests of the estimate on its equations, decimated to the band of its instruments; see `tested`."""
        problem = self.problem.in_band
        numbers = tested(problem.blocks)
        estimate, instruments = residuals_of(self.estimate, numbers), self.instruments
        blocks, method = [problem.blocks[k] for k in numbers], problem.options.method
        if method not in MEASURED:
            blocks = [replace(b, x=z) for b, z in zip(blocks, instruments, strict=True)]
        as_weighed = self.prefiltered and problem is self.problem
        weights = None if as_weighed else joint_variances(blocks, estimate.theta)
        return diagnose_estimate(
            problem.auxiliary.model.base.names,
            [joint.name for joint in problem.auxiliary.model.robot.joints],
            blocks,
            estimate,
            instruments=instruments if method in MEASURED else None,
            weights=weights,
            essential=essential,
        )

    def delay(self) -> TorqueDelay | None:
        """Delay of the recorded torques, with the motion simulated along the recorded reference as instruments.

        ``None`` if its equations have no finite solution.
        """
        problem, prepared = self.problem, self.problem.prepared
        blocks = prepared.equations(problem.plain)
        numbers = tested(blocks)
        x = [blocks[k].x for k in numbers]
        motions = chosen(self.motions, numbers)
        thinned = problem.in_band.auxiliary.decimation == problem.plain
        loop = problem.plain_problem.auxiliary.of_experiments(numbers)
        z = self.instruments if thinned else loop.regressors(motions)
        part = prepared.part(numbers)
        try:
            found = torque_delay(part.model, part.experiments, part.signals, problem.plain, motions, (x, z))
        except (np.linalg.LinAlgError, ValueError) as error:
            if not is_singular(error):
                raise
            return None
        return found if np.isfinite(found.samples).all() and np.isfinite(found.std).all() else None


def is_singular(error: Exception) -> bool:
    """Return true for a singular matrix, and for scipy's ``ValueError`` about numbers that are not finite.

    ``error``: exception of numpy or scipy.
    """
    return isinstance(error, np.linalg.LinAlgError) or NOT_FINITE in str(error)


def solve(problem: Problem) -> Solution:
    """Solution of a problem by the method of its options. Raises DataError if no auxiliary closed loop runs."""
    return _SOLVERS[problem.options.method](problem)


def _idim_piv(problem: Problem) -> Solution:
    """IDIM-PIV (6.2.2), or IDIM-IV where the prefilter contradicts it or does not converge.

    A noise model may move the estimate within its uncertainty only. Where it moves it further, the residual is model
    error and not noise, and the inverse filter amplifies it (thesis section 6.2.3). Then, as in SEP-PEM, the dynamic
    model is estimated without the noise model, which only enters the covariance (6.2.1). The same holds where the
    iterations with the prefilter, which weights frequencies beyond those of the motion, do not converge.
    """
    options, plain = problem.options, problem.plain_problem
    without = idim_iv(plain.blocks, plain.auxiliary, problem.start, serial_order=options.max_ar_order)
    estimate = idim_piv(
        problem.blocks,
        problem.auxiliary,
        without.theta,
        max_order=options.max_ar_order,
        grey_box=options.noise_model == "grey-box",
    )
    difference, black_box = estimate.theta - without.theta, options.noise_model == "black-box"
    with np.errstate(invalid="ignore", divide="ignore"):
        if black_box and np.any(np.abs(difference) > CONTRADICTION * without.std):
            difference = difference - _difference_without_model_error(problem, estimate, without)
        shift = np.nan_to_num(np.abs(difference) / without.std, nan=np.inf)
    worst = int(np.argmax(shift))
    if shift[worst] > CONTRADICTION:
        name = problem.auxiliary.model.base.names[worst]
        reason = Reason(
            "doubtful",
            f"a noise model would move {name} by {shift[worst]:.0f} standard deviations (result: idim-iv), so "
            + (CONTRADICTION_CAUSE if problem.auxiliary.feedback else NO_REFERENCE_CAUSE),
            "armident diagnose RECORDING",
            kind="residual",
        )
    elif without.converged and not estimate.converged:
        reason = Reason(
            "doubtful",
            f"idim-piv did not converge ({estimate.stop_reason}); the result is that of idim-iv",
            "armident diagnose RECORDING",
            kind="convergence",
        )
    else:
        if not black_box:
            return Solution(estimate, problem, noise_of="motor position")
        return _without_bias(Solution(estimate, problem, prefiltered=True))
    return _without_bias(Solution(without, plain, reasons=(reason,)))


def _idim_iv(problem: Problem) -> Solution:
    order = problem.options.max_ar_order
    return _without_bias(
        Solution(idim_iv(problem.blocks, problem.auxiliary, problem.start, serial_order=order), problem)
    )


def _bias(problem: Problem, estimate: Estimate, *, prefiltered: bool, runs: int | None = None) -> SimulatedBias | None:
    """Bias of IDIM-IV or IDIM-PIV on recordings simulated with the estimate; ``None`` if that is impossible.

    Of a long recording the `tested` stretches are simulated: more of them take as much time as all iterations.
    """
    weights = estimate.noise if prefiltered else joint_variances(problem.blocks, estimate.theta)
    numbers = tested(problem.blocks)
    return simulated_bias(
        problem.prepared.part(numbers),
        problem.auxiliary.of_experiments(numbers),
        chosen(problem.blocks, numbers),
        estimate,
        weights,
        problem.options.derivatives or "irwsm",
        runs=runs,
        share=len(numbers) / len(problem.blocks),
    )


def _difference_without_model_error(problem: Problem, estimate: Estimate, without: Estimate) -> Array:
    """Difference (b,) of IDIM-PIV and IDIM-IV on data of exactly the model, by derivatives and sampling alone.

    The prefilter weights high frequencies, at which the smoothed derivatives of few noisy or undecimated samples are
    wrong. The two estimates then differ although the model misses nothing. Zero where no loop can be simulated.
    """
    biases = [
        _bias(problem, estimate, prefiltered=True, runs=FEW),
        _bias(problem.plain_problem, without, prefiltered=False, runs=FEW),
    ]
    if biases[0] is None or biases[1] is None:
        return np.zeros_like(without.theta)
    return biases[0].bias - biases[1].bias


def _without_bias(solution: Solution) -> Solution:
    """The solution without the bias by derivatives, encoder noise and sampling, where that is relevant."""
    problem, estimate = solution.problem, solution.estimate
    found = _bias(problem, estimate, prefiltered=solution.prefiltered)
    if found is None:
        return solution
    worst, share = found.largest(estimate)
    if share <= RELEVANT_BIAS:
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


def _doubted(method: str, solution: Solution) -> Solution:
    """The solution with a warning where serial correlation, which 2.37 neglects, makes its intervals too narrow."""
    problem, estimate = solution.problem, solution.estimate
    simulated = problem.auxiliary.fresh().equations(problem.blocks, estimate.theta)
    noise = noise_models(simulated, estimate.theta, estimate.covariance, problem.options.max_ar_order)
    zeta, keep = [b.x for b in simulated], [b.keep for b in simulated]
    covariance = serial_covariance(zeta, zeta, keep, joint_variances(simulated, estimate.theta), noise)
    names = problem.auxiliary.model.base.names
    doubts = doubts_of_serial_correlation(method, names, estimate, np.sqrt(np.diag(covariance)))
    return replace(
        solution,
        interval_warnings=(*solution.interval_warnings, *doubts),
    )


def _didim(problem: Problem) -> Solution:
    return _doubted("DIDIM", Solution(didim(problem.blocks, problem.auxiliary, problem.start), problem))


def _clie(problem: Problem) -> Solution:
    return _doubted("CLIE", Solution(clie(problem.blocks, problem.auxiliary, problem.start), problem))


def _cloe(problem: Problem) -> Solution:
    positions = [problem.auxiliary.decimation(e.q) for e in problem.prepared.experiments]
    estimate = cloe(problem.blocks, positions, problem.auxiliary, problem.start)
    return Solution(estimate, problem, noise_of="joint position")


def _sep_pem(problem: Problem) -> Solution:
    order = problem.options.max_ar_order
    return Solution(sep_pem(problem.blocks, problem.auxiliary, problem.start, max_order=order), problem)


_SOLVERS: dict[Method, Callable[[Problem], Solution]] = {
    "idim-piv": _idim_piv,
    "idim-iv": _idim_iv,
    "didim": _didim,
    "clie": _clie,
    "cloe": _cloe,
    "sep-pem": _sep_pem,
}
