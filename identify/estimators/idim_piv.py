"""IDIM-PIV: prefiltered instrumental variables (thesis section 6.2.2), after a rough decimation (section 7.2)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.grey_box import InverseController
from armident.identify.estimators.idim_iv import idim_iv
from armident.identify.estimators.problem import Estimator, Problem, Solved
from armident.identify.estimators.reason import DIAGNOSE, Reason
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import (
    Estimate,
    ExperimentEquations,
    instrumented,
    joint_variances,
    noise_models,
    residual_norm,
    whitened_residuals,
)
from armident.identify.regression.iterations import ITERATIONS, iterate
from armident.identify.regression.iv import IvProducts, iv_products
from armident.identify.regression.orders import MAX_AR_ORDER
from armident.identify.signals.streamed import mapped

NOISE_UPDATES = 6
"""Iterations after which the noise models are held: an order that flips between two equal AICs never settles."""


CONTRADICTION = 5.0
"""Standard deviations of IDIM-IV by which IDIM-PIV may differ from it in any parameter before IDIM-IV replaces it: of
100 Gaussian parameters, one differs by more with a probability of 6e-5. The noise model only makes the estimate more
precise, so that the difference of the two scatters less than IDIM-IV itself."""

CONTRADICTION_CAUSE = "they contain errors of the model or its derivatives"
NO_REFERENCE_CAUSE = f"{CONTRADICTION_CAUSE}, or the instruments, which follow the measured motion, share their noise"
"""Causes of a contradiction between IDIM-PIV and IDIM-IV, with instruments from a recorded reference and without."""


def idim_piv(
    blocks: Sequence[ExperimentEquations],
    auxiliary: AuxiliaryModel,
    start: Array,
    iterations: int = ITERATIONS,
    max_order: int = MAX_AR_ORDER,
    *,
    grey_box: bool = False,
) -> Estimate:
    """Alternate the IV estimate of the parameters and an AR model of the noise of each joint.

    Parameters
    ----------
    blocks
        Roughly decimated equations at measured signals; all rows, since a whitening filter needs a gapless record.
    auxiliary
        The simulated closed loop; its instruments pass the same rough decimation.
    start
        First theta of the auxiliary model, shape (b,).
    iterations
        Most iterations.
    max_order
        Highest AR order tried.
    grey_box
        Take the noise for position noise that the controller has turned into torque (6.28). ``noise`` and
        ``residuals`` of the result then belong to the motors' positions (rad or m).

    Notes
    -----
    The noise model is fitted to ``tau - phi(q, qd, qdd) theta``: it is the error that the IV equations 6.30 weigh, and
    whitening it makes their covariance minimal.

    Raises
    ------
    DataError
        If no auxiliary model runs, not even the first.
    """
    auxiliary = auxiliary.fresh()
    controller = InverseController.of(auxiliary, max_order) if grey_box else None

    def seen(equations: Sequence[ExperimentEquations]) -> Sequence[ExperimentEquations]:
        return equations if controller is None else controller(equations)

    measured = seen(blocks)
    scale = joint_variances(measured, start)
    noise: list[ArModel] = scale  # step 1: H = 1, lambda from the start

    def solved(at: Array) -> IvProducts:
        simulated = mapped(lambda block, zeta: replace(block, x=zeta), blocks, auxiliary.instruments(at))
        return iv_products(instrumented(measured, mapped(lambda block: block.x, seen(simulated))), noise)  # 6.30

    def step(previous: Array, k: int) -> tuple[Array, float]:
        nonlocal noise
        products = solved(previous)  # steps 2a and 2b
        estimate = products.theta
        if k <= NOISE_UPDATES:
            noise = noise_models(measured, estimate, products.covariance, max_order)  # step 2c
        return estimate, residual_norm(measured, estimate, scale)

    theta, done, converged, reason = iterate(step, start, iterations)
    covariance = solved(theta).covariance
    residuals = whitened_residuals(measured, theta, noise)
    return Estimate(theta, covariance, tuple(noise), residuals, done, converged, reason, auxiliary.warnings)


def _solve(problem: Problem) -> Solved:
    """IDIM-PIV, or IDIM-IV where the prefilter contradicts it or does not converge.

    A noise model may move the estimate within its uncertainty only. Beyond, the residual is model error, which the
    inverse filter amplifies (thesis section 6.2.3); the noise model then only enters the covariance, as in SEP-PEM
    (6.2.1). The same holds where the iterations with the prefilter do not converge.
    """
    plain, order = problem.plain_problem, problem.max_ar_order
    without = idim_iv(plain.blocks, plain.auxiliary, problem.start, serial_order=order)
    estimate = idim_piv(problem.blocks, problem.auxiliary, without.theta, max_order=order, grey_box=problem.grey_box)
    difference = estimate.theta - without.theta
    with np.errstate(invalid="ignore", divide="ignore"):
        if not problem.grey_box and np.any(np.abs(difference) > CONTRADICTION * without.std):
            difference = difference - _difference_without_model_error(problem, estimate, without)
        shift = np.nan_to_num(np.abs(difference) / without.std, nan=np.inf)
    worst = int(np.argmax(shift))
    if shift[worst] > CONTRADICTION:
        name = problem.auxiliary.model.base.names[worst]
        message = (
            f"a noise model would move {name} by {shift[worst]:.0f} standard deviations (result: idim-iv), so "
            + (CONTRADICTION_CAUSE if problem.auxiliary.feedback else NO_REFERENCE_CAUSE)
        )
        reason = Reason("doubtful", message, DIAGNOSE, kind="residual")
    elif without.converged and not estimate.converged:
        message = f"idim-piv did not converge ({estimate.stop_reason}); the result is that of idim-iv"
        reason = Reason("doubtful", message, DIAGNOSE, kind="convergence")
    elif problem.grey_box:
        return Solved(estimate, noise_of="motor position")
    else:
        return Solved(estimate, prefiltered=True)
    return Solved(without, plain=True, reasons=(reason,))


def _difference_without_model_error(problem: Problem, estimate: Estimate, without: Estimate) -> Array:
    """Difference (b,) of IDIM-PIV and IDIM-IV on data of exactly the model; zero where no loop can be simulated.

    The prefilter weights high frequencies, at which the smoothed derivatives of few noisy samples are wrong.
    """
    refined = problem.bias(estimate, prefiltered=True)
    plain = problem.plain_problem.bias(without, prefiltered=False)
    return np.zeros_like(without.theta) if refined is None or plain is None else refined - plain


ESTIMATOR = Estimator(
    "idim-piv",
    _solve,
    "IDIM-IV with a prefilter by the noise model, black box or grey box; the default method.",
    "6.2.2 (6.28, 6.30, 6.31), 7.2",
    measured=True,
    prefiltered=True,
)
