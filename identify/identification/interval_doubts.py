"""Reasons why intervals are doubtful: of IDIM-LS, without instruments, and of methods without a noise model."""

from collections.abc import Sequence

import numpy as np

from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.estimators.residual_tests import ljung_box
from armident.identify.identification.equations import Prepared
from armident.identify.identification.options import Options
from armident.identify.identification.result import Array, LeastSquares
from armident.identify.identification.simulated_bias import RELEVANT_BIAS, least_squares_bias
from armident.identify.regression.equations import Estimate
from armident.identify.signals.differentiate import Derivatives, differentiate

UNDERSTATED = 1.25
"""Ratio of standard deviations with and without serial correlation above which intervals are doubtful: a 2-sigma
interval that is too narrow by this factor holds the truth in 89 % of the cases."""

FEW_LAGS, CORRELATED = 5, 1e-3
"""Lags and level of the test for serial correlation. The parallel filter alone, whose cut-off is the decimated Nyquist
frequency, correlates neighbours by about 0.1, which is no reason for doubt."""


def doubts_of_least_squares(
    prepared: Prepared, options: Options, ls: LeastSquares, bandwidth: float
) -> tuple[str, ...]:
    """Warnings if derivatives and encoder noise bias IDIM-LS, or if serial correlation understates its intervals.

    ``prepared``: arm, experiments and derivatives. ``ls``: estimate and its equations; those of a published fit are not
    examined. ``bandwidth``: closed-loop bandwidth, Hz.
    """
    if ls.published:
        return ()
    name = options.derivatives or "irwsm"

    def smooth(q: Array, k: int) -> Derivatives:
        used, e = prepared.signals[k].nvr, prepared.experiments[k]
        return differentiate(q, e.dt, name, None if used is None else used[:, 0], bandwidth)

    names, doubts = prepared.model.base.names, []
    found = least_squares_bias(prepared, ls.decimation, ls.blocks, ls.estimate, smooth)
    worst, share = found.largest(ls.estimate)
    if share > RELEVANT_BIAS:
        doubts.append(
            f"Derivatives and encoder noise bias IDIM-LS ({names[worst]} by about {share:.1f} std): its intervals are "
            "doubtful. Next: IDIM-IV or IDIM-PIV."
        )
    serial = idim_ls(ls.blocks, names, weighted=options.weighted, serial_order=options.max_ar_order)
    doubts += doubts_of_serial_correlation("IDIM-LS", names, ls.estimate, serial.std)
    return tuple(doubts)


def doubts_of_serial_correlation(method: str, names: Sequence[str], estimate: Estimate, std: Array) -> tuple[str, ...]:
    """Warning if the residuals of a joint are not white (Ljung and Box 1978) and intervals are too narrow for it.

    ``names``: base parameters (b,); ``estimate``: estimate whose covariance takes the residuals for white; ``std``:
    standard deviations (b,) that allow for serial correlation, SI.
    """
    ratio = std / estimate.std
    worst = int(np.argmax(ratio))
    white = all(ljung_box(series, FEW_LAGS)[2] >= CORRELATED for series in estimate.residuals)
    if white or ratio[worst] <= UNDERSTATED:
        return ()
    return (
        f"The residuals of {method} are serially correlated, which its covariance neglects (the std of {names[worst]} "
        f"would be {ratio[worst]:.1f} times as large): its intervals are doubtful. Next: IDIM-IV or IDIM-PIV.",
    )
