"""Chapter 6: noise models."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from armident.identify.identification.identification_result import relative_torque_errors
from armident.identify.regression.ar_noise import ArModel
from tests.reproduction.cached_estimates import PIV_CUTOFF_HZ, Case, Laboratory, Run
from tests.reproduction.chapter5 import GOOD, POOR_IV
from tests.reproduction.context import Bench, TableFunction, estimates, figures, iterations
from tests.reproduction.reference import REFERENCE, reference_tables
from tests.reproduction.tables import Table

UNDECIMATED = Case(cutoff_hz=None, midway=True)
"""No decimation, for the noise model of the residual (thesis section 6.2.1)."""
ROUGH = Case(cutoff_hz=PIV_CUTOFF_HZ)
"""Decimation before IDIM-PIV (thesis section 7.2)."""
POINTS = 3600
"""Points per turn of the degraded encoders (thesis section 6.3.3)."""
COARSE = Case("bandpass", encoder_points=POINTS)
COARSE_HZ = (20.0, 30.0, 40.0, 50.0, 75.0, 100.0)
"""Parallel filters tried for the IDIM-LS column of table 6.7, Hz; the thesis does not state it."""
COARSE_CARELESS = replace(POOR_IV, encoder_points=POINTS)
COARSE_ROUGH = Case(cutoff_hz=PIV_CUTOFF_HZ, encoder_points=POINTS)
LONGEST_RESPONSE = 20_000
"""Length of the impulse response of a noise model, samples."""

ROUGHLY = (
    f"IDIM-PIV: rough decimation ({PIV_CUTOFF_HZ:.0f} Hz) before the prefilter as section 7.2 advises, start from "
    "IDIM-IV; errors on the equations of IDIM-IV"
)
ROUNDED = f"recorded joint positions rounded to {POINTS} points per turn"
SMEARED = (
    "instrumental variables overestimate Coulomb friction, here as in the thesis: the smoothed sign of a noisy "
    "velocity is too small on average"
)


def table_6_1(bench: Bench) -> Table:
    """DIDIM and SEP-PEM."""
    return estimates(bench, "6.1", [("DIDIM", "didim", GOOD), ("SEP-PEM", "sep-pem", UNDECIMATED)])


def table_6_2(bench: Bench) -> Table:
    """Errors and iterations of DIDIM and SEP-PEM."""
    lab = bench.virtual
    plain, refined = lab.run("didim", GOOD), lab.run("sep-pem", UNDECIMATED)
    order = float(np.mean([ar.order for ar in refined.estimate.noise]))
    return figures(
        "6.2",
        {
            "error, %": [plain.error_pct, simulated_error(lab, refined, GOOD)],
            "iterations": [iterations(plain), iterations(refined)],
            "mean AR order": [None, order],
        },
        ["SEP-PEM: error on the decimated equations of DIDIM"],
    )


def table_6_3(bench: Bench) -> Table:
    """Variances of encoder, noise and residuals."""
    lab = bench.virtual
    refined, plain = lab.run("sep-pem", UNDECIMATED), lab.run("didim", GOOD)
    robot = lab.model.robot
    resolution = [
        (2 * np.pi / (joint.drive.counts_per_unit or np.nan) / robot.transmission_matrix[j, j]) ** 2
        for j, joint in enumerate(robot.joints)
    ]
    return figures(
        "6.3",
        {
            "squared encoder resolution, rad^2": resolution,
            "e": [ar.variance for ar in refined.estimate.noise],
            "DIDIM residual, not decimated": simulated_variances(lab, refined, UNDECIMATED),
            "DIDIM residual, decimated": simulated_variances(lab, plain, GOOD),
        },
        ["the noise of the virtual arm is set by the last two rows of the thesis"],
    )


def table_6_4(bench: Bench) -> Table:
    """IDIM-IV and grey-box IDIM-PIV."""
    return estimates(
        bench, "6.4", [("IDIM-IV", "idim-iv", Case()), ("IDIM-PIV", "idim-piv, grey box", ROUGH)], [ROUGHLY]
    )


def table_6_5(bench: Bench) -> Table:
    """Errors and iterations with the grey-box noise model."""
    lab = bench.virtual
    plain, refined = lab.run("idim-iv", Case()), lab.run("idim-piv, grey box", ROUGH)
    return figures(
        "6.5",
        {
            "error, %": [plain.error_pct, inverse_error(lab, refined, Case())],
            "iterations": [iterations(plain), iterations(refined)],
        },
        [ROUGHLY],
    )


def table_6_6(bench: Bench) -> Table:
    """Variances of position noise equivalent to the residuals."""
    noise = bench.virtual.run("idim-piv, grey box", ROUGH).estimate.noise
    return figures(
        "6.6",
        {"n_q, rad^2": [process_variance(ar) for ar in noise], "e, rad^2": [ar.variance for ar in noise]},
        ["at the motors, after the rough decimation"],
    )


def table_6_7(bench: Bench) -> Table:
    """Degraded encoders."""
    near = nearest(degraded(bench.virtual))
    hz = near.case.cutoff_hz
    return estimates(
        bench,
        "6.7",
        [
            ("IDIM-LS", "idim-ls", COARSE),
            (f"IDIM-LS, {hz:.0f} Hz", "idim-ls", near.case),
            ("IDIM-IV", "idim-iv", COARSE),
            (f"IDIM-IV, {hz:.0f} Hz", "idim-iv", near.case),
            ("IDIM-PIV", "idim-piv", COARSE_ROUGH),
        ],
        [
            ROUNDED,
            f"the parallel filter is not stated: {COARSE.cutoff_hz:.0f} Hz is that of a known bandwidth, with "
            f"{hz:.0f} Hz the errors of IDIM-LS are nearest to the thesis's (correlation {near.correlation:.2f})",
            ROUGHLY,
            SMEARED,
        ],
    )


@dataclass(frozen=True)
class Degraded:
    """IDIM-LS with degraded encoders and one parallel filter, compared with the published column.

    ``case``: filters of the estimate; ``run``: estimate of IDIM-LS; ``distance``: RMS difference between our errors and
    the published ones (against table B.4), in standard deviations of IDIM-LS with good encoders; ``correlation``:
    correlation of both over the parameters.
    """

    case: Case
    run: Run
    distance: float
    correlation: float


def degraded(lab: Laboratory) -> list[Degraded]:
    """Run IDIM-LS with degraded encoders and each of the parallel filters."""
    tables = reference_tables()
    printed, right = (np.array([tables[n].estimates[name][0] for name in lab.names]) for n in ("6.7", REFERENCE))
    std = lab.run("idim-ls", GOOD).estimate.std
    theirs = (printed - right) / std
    found = []
    for hz in COARSE_HZ:
        case = replace(COARSE, cutoff_hz=hz)
        run = lab.run("idim-ls", case)
        ours = (run.estimate.theta - lab.truth) / std
        distance = float(np.sqrt(np.mean((ours - theirs) ** 2)))
        found.append(Degraded(case, run, distance, float(np.corrcoef(ours, theirs)[0, 1])))
    return found


def nearest(found: Sequence[Degraded]) -> Degraded:
    """Return the run that is closest to the published column."""
    return min(found, key=lambda one: one.distance)


def table_6_8(bench: Bench) -> Table:
    """Errors and iterations with degraded encoders."""
    lab = bench.virtual
    plain, refined = lab.run("idim-iv", COARSE), lab.run("idim-piv", COARSE_ROUGH)
    rough = nearest(degraded(lab)).case
    other = lab.run("idim-iv", rough)
    return figures(
        "6.8",
        {
            "error, %": [plain.error_pct, inverse_error(lab, refined, COARSE)],
            "iterations": [iterations(plain), iterations(refined)],
            f"error with {rough.cutoff_hz:.0f} Hz, %": [other.error_pct, inverse_error(lab, refined, rough)],
        },
        [ROUNDED, ROUGHLY],
    )


def process_variance(ar: ArModel) -> float:
    """Return the variance of an AR process: that of its white input times the energy of its impulse response."""
    impulse = np.zeros(LONGEST_RESPONSE)
    impulse[0] = 1.0
    return ar.variance * float(np.sum(signal.lfilter([1.0], np.append(1.0, ar.coefficients), impulse) ** 2))


def inverse_error(lab: Laboratory, run: Run, case: Case) -> float:
    """Return the relative error of a run on the equations of another case, percent.

    ``lab``: arm with its cached estimates; ``case``: filters of the equations.
    """
    return relative_torque_errors(lab.equations(case), run.estimate.theta)[0]


def simulated_error(lab: Laboratory, run: Run, case: Case) -> float:
    """Return the relative error of a run with the simulated regressor of a case, percent.

    ``lab``: arm with its cached estimates; ``case``: filters and auxiliary simulation.
    """
    return relative_torque_errors(lab.simulated(run, case), run.estimate.theta)[0]


def simulated_variances(lab: Laboratory, run: Run, case: Case) -> list[float]:
    """Return the variance of measured minus simulated torque of each joint, (N m)^2.

    ``lab``: arm with its cached estimates; ``case``: filters and auxiliary simulation.
    """
    (block,) = lab.simulated(run, case)
    return [float(v) for v in np.var(block.y - block.x @ run.estimate.theta, axis=0)]


TABLES: dict[str, TableFunction] = {
    "6.1": table_6_1,
    "6.2": table_6_2,
    "6.3": table_6_3,
    "6.4": table_6_4,
    "6.5": table_6_5,
    "6.6": table_6_6,
    "6.7": table_6_7,
    "6.8": table_6_8,
}
