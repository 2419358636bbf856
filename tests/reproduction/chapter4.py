"""Chapter 4: sensitivity of outputs and inputs, robustness to errors of the simulator."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.reproduction.aircraft import DURATION, SAMPLING_HZ, aircraft_sensitivity
from tests.reproduction.cached_estimates import Case, Laboratory, Run
from tests.reproduction.context import Bench, TableFunction, estimates, figures, iterations
from tests.reproduction.singular_values import Sensitivity, sensitivity
from tests.reproduction.tables import Table

Array = NDArray[np.float64]

GOOD = Case("bandpass")
UNDECIMATED = Case("bandpass", cutoff_hz=None)
WRONG = replace(GOOD, gear_ratio=0.8)
"""Gear ratios of the simulator at 80 % (thesis section 4.2.3)."""

AT_DIDIM = "Jacobians at the estimate of DIDIM, unweighted"


def table_4_1(bench: Bench) -> Table:
    """CLIE and CLOE without decimation."""
    note = "standard deviations assume white residuals; without decimation they are not white"
    return estimates(bench, "4.1", [("CLIE", "clie", UNDECIMATED), ("CLOE", "cloe", UNDECIMATED)], [note])


def table_4_2(bench: Bench) -> Table:
    """Singular values of the Jacobians of CLIE and CLOE without decimation."""
    return figures("4.2", spread(bench, UNDECIMATED), [AT_DIDIM])


def table_4_3(bench: Bench) -> Table:
    """Relative errors of the simulated positions and torques of CLIE and CLOE."""
    runs = [bench.virtual.run(method, UNDECIMATED) for method in ("clie", "cloe")]
    errors = [simulation_errors(bench.virtual, run) for run in runs]
    return figures(
        "4.3",
        {"position": [e[0] for e in errors], "torque": [e[1] for e in errors]},
        ["ours contain the noise of table 6.3 before decimation, which acts partly on the virtual arm"],
    )


def table_4_4(bench: Bench) -> Table:
    """CLIE, CLOE and DIDIM with decimation."""
    return estimates(bench, "4.4", [("CLIE", "clie", GOOD), ("CLOE", "cloe", GOOD), ("DIDIM", "didim", GOOD)])


def table_4_5(bench: Bench) -> Table:
    """Singular values of the Jacobians with decimation, computing times and simulations."""
    runs = [bench.virtual.run(method, GOOD) for method in ("clie", "cloe", "didim")]
    rows: dict[str, list[float | None]] = dict(spread(bench, GOOD, with_didim=True))
    rows["time, s"] = [run.seconds for run in runs]
    rows["iterations"] = [iterations(run) for run in runs]
    rows["simulations"] = [float(run.simulations) for run in runs]
    return figures("4.5", rows, [AT_DIDIM, "times are from two different machines"])


def table_4_6(bench: Bench) -> Table:
    """IDIM-IV and DIDIM with correct and wrong gear ratios."""
    return estimates(
        bench,
        "4.6",
        [
            ("IDIM-IV", "idim-iv", GOOD),
            ("DIDIM", "didim", GOOD),
            ("IDIM-IV, 80 %", "idim-iv", WRONG),
            ("DIDIM, 80 %", "didim", WRONG),
        ],
    )


def table_4_7(bench: Bench) -> Table:
    """Relative errors and iterations of IDIM-IV and DIDIM."""
    lab = bench.virtual
    runs = [lab.run(method, case) for case in (GOOD, WRONG) for method in ("idim-iv", "didim")]
    return figures(
        "4.7",
        {"error, %": [run.error_pct for run in runs], "iterations": [iterations(run) for run in runs]},
        ["DIDIM: error of the simulated torque", "ours stop at a relative change of 1e-4"],
    )


def table_4_8(_: Bench) -> Table:
    """Singular values for a plant with fewer inputs than outputs."""
    found = aircraft_sensitivity()
    values = (found.clie, found.cloe)
    return figures(
        "4.8",
        {
            "largest": [float(v[0]) for v in values],
            "smallest": [float(v[-1]) for v in values],
            "condition": [float(v[0] / v[-1]) for v in values],
        },
        [
            "no robot: the F-4C Phantom at Mach 1.1 of Cook (2007), example 11.6, with the loop of figure 4.6",
            f"the thesis states neither sampling rate nor duration: {SAMPLING_HZ:g} Hz give its largest value of CLOE, "
            f"for {DURATION:g} s; singular values grow with the square root of the rate, condition numbers do not",
        ],
    )


def singular_values(lab: Laboratory, case: Case) -> Sensitivity:
    """Return singular values of the Jacobians of CLIE, CLOE and DIDIM at the estimate of DIDIM.

    ``lab``: arm with its cached estimates; ``case``: filters and auxiliary simulation.
    """
    theta = lab.run("didim", case).estimate.theta
    return lab.once(("singular values", case), lambda: sensitivity(lab.auxiliary(case), theta))


def spread(bench: Bench, case: Case, *, with_didim: bool = False) -> dict[str, list[float | None]]:
    """Return the largest and smallest singular value and their ratio, one column per method.

    ``bench``: arms with their cached estimates; the virtual one is used. ``case``: filters and auxiliary simulation.
    ``with_didim``: add a column for DIDIM to those of CLIE and CLOE.
    """
    values = singular_values(bench.virtual, case)
    chosen = [values.clie, values.cloe, *([values.didim] if with_didim else [])]
    return {
        "largest": [float(v[0]) for v in chosen],
        "smallest": [float(v[-1]) for v in chosen],
        "condition": [float(v[0] / v[-1]) for v in chosen],
    }


def simulation_errors(lab: Laboratory, run: Run) -> tuple[float, float]:
    """Return the relative errors of simulated positions and torques, percent.

    ``lab``: arm with its cached estimates; ``run``: estimate, whose parameters are simulated without decimation.
    """
    experiment = lab.recording(UNDECIMATED).experiment
    runs = lab.auxiliary(UNDECIMATED).simulate(run.estimate.theta)
    assert runs is not None
    return relative(experiment.q, runs[0].q), relative(experiment.tau, runs[0].tau)


def relative(measured: Array, simulated: Array) -> float:
    """Return ``|measured - simulated| / |measured|`` over all joints, percent.

    ``measured``, ``simulated``: signals of the same unit, shape (N, n).
    """
    return 100 * float(np.linalg.norm(measured - simulated) / np.linalg.norm(measured))


TABLES: dict[str, TableFunction] = {
    "4.1": table_4_1,
    "4.2": table_4_2,
    "4.3": table_4_3,
    "4.4": table_4_4,
    "4.5": table_4_5,
    "4.6": table_4_6,
    "4.7": table_4_7,
    "4.8": table_4_8,
}
