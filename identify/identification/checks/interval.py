"""Check of the standard deviations: bias and serial correlation that they neglect."""

from armident.arrays import Array
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.estimators.reason import Reason
from armident.identify.identification.checks.judged import Judged
from armident.identify.identification.equations import Prepared
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.identification_result import LeastSquares
from armident.identify.identification.options import Options
from armident.identify.identification.simulated_bias import least_squares_bias
from armident.identify.identification.solvers import doubts_of_serial_correlation
from armident.identify.signals.differentiate import Derivatives, differentiate


def interval(judged: Judged, criteria: IdentificationCriteria) -> list[Reason]:
    """Reasons for which intervals are doubtful, as estimator and statistics found them."""
    return [interval_reason(line) for line in judged.statistics.interval_warnings]


def interval_reason(line: str) -> Reason:
    """Reason for the verdict from a line about intervals, which ends with the next step."""
    message, _, step = line.partition(" Next: ")
    message = message.rstrip(".")
    return Reason("doubtful", message[0].lower() + message[1:], step.rstrip("."), kind="uncertainty")


def doubts_of_least_squares(
    prepared: Prepared, options: Options, ls: LeastSquares, bandwidth: float
) -> tuple[str, ...]:
    """Warnings if noise biases IDIM-LS, or serial correlation understates its intervals; none for a published fit."""
    if ls.published:
        return ()
    name = options.derivatives or "irwsm"

    def smooth(q: Array, k: int) -> Derivatives:
        used, e = prepared.signals[k].nvr, prepared.experiments[k]
        return differentiate(q, e.dt, name, None if used is None else used[:, 0], bandwidth)

    names, doubts = prepared.model.base.names, []
    found = least_squares_bias(prepared, ls.decimation, ls.blocks, ls.estimate, smooth)
    worst, share = found.largest(ls.estimate)
    if share > IdentificationCriteria.max_bias_std:
        doubts.append(
            f"Derivatives and encoder noise bias IDIM-LS ({names[worst]} by about {share:.1f} std): its intervals are "
            "doubtful. Next: IDIM-IV or IDIM-PIV."
        )
    serial = idim_ls(ls.blocks, names, weighted=options.weighted, serial_order=options.max_ar_order)
    doubts += doubts_of_serial_correlation("IDIM-LS", names, ls.estimate, serial.std)
    return tuple(doubts)
