"""Chapter 5: derivatives without knowledge of the bandwidth, unknown controller."""

from dataclasses import replace
from typing import Literal

from armident.configs import DataError
from armident.identify.controller.crc import PREWHITENING_ORDER
from armident.identify.signals.choices import NvrRule
from tests.reproduction.cached_estimates import Case, Method
from tests.reproduction.context import Bench, TableFunction, estimates, figures, iterations
from tests.reproduction.emps_protocol import evidence, inferred_rows
from tests.reproduction.tables import Column, Table
from tests.reproduction.two_stages import TwoStages, structure_given, two_stages

GOOD = Case("bandpass")
"""Known bandwidth: filters of 50 Hz and 20 Hz (thesis section 5.3.1)."""
POOR_LS = Case("bandpass", bandpass_hz=200.0, cutoff_hz=100.0)
"""Bandwidth overestimated by a factor of two, filters of IDIM-LS (thesis section 5.3.1)."""
POOR_IV = Case("bandpass", bandpass_hz=180.0, cutoff_hz=150.0)
"""Bandwidth overestimated by a factor of three, filters of IDIM-IV (thesis section 5.3.2)."""
NOTHING = Case("differences", cutoff_hz=None)
"""No filters (thesis section 5.3.2.1)."""
BY_HAND = 1e-5
"""Noise-variance ratio of the thesis where it is not estimated (thesis section 5.3.1)."""

ACTUAL = Case()
IMPULSE_RESPONSES = Case(controller="cra", start="idim-ls")
"""Responses from the tracking error (thesis section 5.3.3); the loop may diverge from a start with rotors only."""
OWN_RESPONSES = Case(controller="crc", start="idim-ls")
"""Our responses, with one from the velocity if held-out data support it."""
KNOWN_STRUCTURE = Case(controller="parametric")

FEEDBACK = ", velocity feedback"
CONTROLLERS = (
    "CRC: from the tracking error alone, with the lengths of table 5.12, IDIM-IV from the estimate of IDIM-LS; "
    "velocity feedback: the same arm with drives of that kind"
)
IN_NUMBERS = ("distance, std", "closed loop, %", "gains, %", "simulations", "time, s")
DISTANCE = (
    "distance from the true parameters of the virtual arm, in standard deviations of IDIM-IV with the actual "
    "controller: about 1 for an unbiased estimate"
)
SERIAL = "standard deviations without a well-tuned parallel filter are too small: residuals are serially correlated"


def table_5_1(bench: Bench) -> Table:
    """Noise-variance ratios of the joints."""
    Rows = dict[str, list[float | None]]
    rows: Rows = {}
    measured: Rows | None = None if bench.measured is None else {}
    smoothers: tuple[tuple[str, Literal["irwsm", "irwsm2"]], ...] = (("IRWSM 1", "irwsm"), ("IRWSM 2", "irwsm2"))
    rules: tuple[tuple[str, NvrRule], ...] = (
        ("likelihood", "likelihood"),
        ("tracking error", "tracking-error"),
        ("automatic", "automatic"),
    )
    for model, derivatives in smoothers:
        for label, nvr in rules:
            case = Case(derivatives=derivatives, nvr=nvr)
            for lab, into in ((bench.virtual, rows), (bench.measured, measured)):
                if lab is not None and into is not None and not (lab is bench.measured and nvr == "tracking-error"):
                    ratios = lab.derivatives(case).nvr
                    assert ratios is not None
                    into[f"{model}, {label}"] = ratios[:, 0].tolist()
    return figures(
        "5.1",
        rows,
        ["IRWSM 1: of the first pass", "the thesis does not state which of its rows is which"],
        measured=measured,
    )


def smoothed(case: Case) -> tuple[Case, Case]:
    """Return a case with IRWSM 1 and with IRWSM 2 instead of the bandpass, with NVR by likelihood unless given."""
    nvr = "likelihood" if case.nvr == "automatic" else case.nvr
    return replace(case, derivatives="irwsm", nvr=nvr), replace(case, derivatives="irwsm2", nvr=nvr)


def table_5_2(bench: Bench) -> Table:
    """Errors of the derivatives on the simulated EMPS."""
    inferred = inferred_rows(bench.simulations)
    ours = bench.emps_derivatives()
    found = {row.label: row.ours for row in [*ours[: len(inferred)], *inferred, *ours[len(inferred) :]]}
    signals = {
        signal: [found[name][k] for name in found] for k, signal in enumerate(("position", "velocity", "acceleration"))
    }
    return figures(
        "5.2",
        signals,
        [
            f"mean of {bench.simulations} noise realisations (the thesis: 100); at 5 kHz where not inferred",
            *evidence(inferred),
        ],
        names=tuple(found),
    )


def table_5_3(bench: Bench) -> Table:
    """Two-stage methods: figures of the corresponding pairs of our methods on the virtual arm."""
    pairs: dict[str, tuple[Case, Literal["idim-iv", "didim"]]] = {
        "PEM2": (KNOWN_STRUCTURE, "didim"),
        "PROJ": (IMPULSE_RESPONSES, "didim"),
        "RIV2": (KNOWN_STRUCTURE, "idim-iv"),
        "CRC, IDIM-IV": (IMPULSE_RESPONSES, "idim-iv"),
        "CRC with velocity, DIDIM": (OWN_RESPONSES, "didim"),
    }
    rows = {
        label: [
            figure for lab in (bench.virtual, bench.feedback) for figure in _in_numbers(two_stages(lab, method, case))
        ]
        for label, (case, method) in pairs.items()
    }
    return figures(
        "5.3",
        rows,
        [
            "the methods of the thesis are for linear systems; ours have the same steps: PEM2 parametric controller by "
            "refined IV, then DIDIM; PROJ impulse responses, then DIDIM; RIV2 that parametric controller, then IDIM-IV",
            "VCM is not reproduced: its four filters are designed by hand, and the thesis does not use it",
            "empty: no closed loop that can be simulated, or no convergence",
            DISTANCE,
            CONTROLLERS,
        ],
        names=[f"{name}{drives}" for drives in ("", FEEDBACK) for name in IN_NUMBERS],
    )


def table_5_4(bench: Bench) -> Table:
    """Approaches by prior knowledge and aim: their errors on the virtual arm."""
    rows: dict[str, list[float | None]] = {"structure known": [], "structure unknown": []}
    for lab in (bench.virtual, bench.feedback):
        responses = _in_numbers(two_stages(lab, "idim-iv", IMPULSE_RESPONSES))
        parametric = {
            "structure known": structure_given(lab),
            "structure unknown": two_stages(lab, "idim-iv", KNOWN_STRUCTURE),
        }
        for label, found in parametric.items():
            rows[label] += [*_in_numbers(found)[:3], *responses[:2]]
    names = [f"parametric: {name}" for name in IN_NUMBERS[:3]] + [f"non-parametric: {name}" for name in IN_NUMBERS[:2]]
    return figures(
        "5.4",
        rows,
        [
            "whole closed loop: errors of the torques simulated with both, and of the drives' gains; robot: distance",
            "parametric: by refined IV, its structure chosen on held-out data where unknown; non-parametric: CRC; then "
            "IDIM-IV",
            DISTANCE,
            CONTROLLERS,
        ],
        names=[f"{name}{drives}" for drives in ("", FEEDBACK) for name in names],
    )


def table_5_5(bench: Bench) -> Table:
    """IDIM-LS with a known bandwidth."""
    first, second = smoothed(GOOD)
    columns: list[tuple[str, Method, Case]] = [
        ("bandpass", "idim-ls", GOOD),
        ("IRWSM 1", "idim-ls", first),
        ("IRWSM 2", "idim-ls", second),
    ]
    return estimates(bench, "5.5", columns)


def table_5_6(bench: Bench) -> Table:
    """Relative errors of IDIM-LS."""
    rows: dict[str, list[Case | None]] = {
        "good knowledge": [GOOD, *smoothed(GOOD)],
        "poor knowledge": [POOR_LS, *smoothed(POOR_LS)],
        "poor knowledge, NVR 1e-5": [None, *smoothed(replace(POOR_LS, nvr=BY_HAND))],
    }
    found = {
        source: {
            label: [None if case is None else lab.run("idim-ls", case).error_pct for case in cases]
            for label, cases in rows.items()
        }
        for source, lab in bench.arms("idim-ls")
    }
    return figures("5.6", found["virtual"], measured=found.get("measured"))


def table_5_7(bench: Bench) -> Table:
    """IDIM-LS with a poorly known bandwidth."""
    by_hand = replace(POOR_LS, nvr=BY_HAND)
    columns: list[tuple[str, Method, Case]] = [
        ("bandpass", "idim-ls", POOR_LS),
        ("IRWSM 1", "idim-ls", smoothed(POOR_LS)[0]),
        ("IRWSM 2", "idim-ls", smoothed(POOR_LS)[1]),
        ("IRWSM 1, NVR 1e-5", "idim-ls", smoothed(by_hand)[0]),
        ("IRWSM 2, NVR 1e-5", "idim-ls", smoothed(by_hand)[1]),
        ("IRWSM 1, automatic", "idim-ls", replace(POOR_LS, derivatives="irwsm")),
    ]
    return estimates(bench, "5.7", columns, [SERIAL])


def table_5_8(bench: Bench) -> Table:
    """IDIM-IV with a poorly known bandwidth."""
    columns: list[tuple[str, Method, Case]] = [
        ("IDIM-LS bandpass", "idim-ls", POOR_IV),
        ("IDIM-IV bandpass", "idim-iv", POOR_IV),
        ("IDIM-IV IRWSM 1", "idim-iv", smoothed(POOR_IV)[0]),
        ("IDIM-IV IRWSM 2", "idim-iv", smoothed(POOR_IV)[1]),
    ]
    return estimates(bench, "5.8", columns, [SERIAL])


def table_5_9(bench: Bench) -> Table:
    """Iterations of IDIM-IV."""
    rows = {"poor knowledge": POOR_IV, "no knowledge": NOTHING}
    found = {
        label: [iterations(bench.virtual.run("idim-iv", c)) for c in (case, *smoothed(case))]
        for label, case in rows.items()
    }
    return figures("5.9", found, ["ours stop at a relative change of 1e-4; without filters, 'bandpass' is differences"])


def table_5_10(bench: Bench) -> Table:
    """Relative errors with poor and without knowledge of the bandwidth."""
    rows = {"poor knowledge": POOR_IV, "no knowledge": NOTHING}
    found: dict[str, list[float | None]] = {}
    for label, case in rows.items():
        runs = [bench.virtual.run("idim-iv", c) for c in (case, *smoothed(case))]
        found[label] = [bench.virtual.run("idim-ls", case).error_pct, *(run.error_pct for run in runs)]
    measured = None
    if bench.measured is not None:
        lab = bench.measured
        measured = {label: [lab.run("idim-ls", case).error_pct, None, None, None] for label, case in rows.items()}
    return figures("5.10", found, measured=measured)


def table_5_11(bench: Bench) -> Table:
    """Estimates without filters."""
    columns: list[tuple[str, Method, Case]] = [
        ("IDIM-LS differences", "idim-ls", NOTHING),
        ("IDIM-IV IRWSM 1", "idim-iv", smoothed(NOTHING)[0]),
        ("IDIM-IV IRWSM 2", "idim-iv", smoothed(NOTHING)[1]),
    ]
    return estimates(bench, "5.11", columns, [SERIAL])


def table_5_12(bench: Bench) -> Table:
    """Lengths and orders of the correlation analysis."""
    found = bench.virtual.identified(OWN_RESPONSES).responses
    rows: dict[str, list[float]] = {
        "length": [float(r.error_taps.size) for r in found],
        "prewhitening order": [float(r.prewhitening_order) for r in found],
    }
    for drives, lab in (("", bench.virtual), (FEEDBACK, bench.feedback)):
        for sizes, case in (("", OWN_RESPONSES), (", tracking error alone, lengths of the thesis", IMPULSE_RESPONSES)):
            responses = lab.identified(case).responses
            rows[f"explained torque, %{drives}{sizes}"] = [r.fit_pct for r in responses]
    notes = [
        f"chosen by held-out data; at most {PREWHITENING_ORDER} for the prewhitening",
        "explained: of the variance of held-out torque",
    ]
    return figures("5.12", rows, notes)


def table_5_13(bench: Bench) -> Table:
    """Estimates with an unknown controller."""
    columns: list[tuple[str, Method, Case]] = [
        ("IDIM-LS", "idim-ls", ACTUAL),
        ("IDIM-IV (CRC)", "idim-iv", IMPULSE_RESPONSES),
        ("IDIM-IV (C)", "idim-iv", KNOWN_STRUCTURE),
    ]
    table = estimates(bench, "5.13", columns, [CONTROLLERS])
    columns.append(("DIDIM (CRC)", "didim", IMPULSE_RESPONSES))
    lab, extra = bench.feedback, []
    for name, method, case in columns:
        try:
            extra.append(lab.column(f"{name}{FEEDBACK}", lab.run(method, case)))
        except DataError:
            extra.append(Column("virtual", f"{name}{FEEDBACK}", {}))
    *others, own = table.columns
    return replace(table, columns=(*others, *extra, own))


def table_5_14(bench: Bench) -> Table:
    """Relative errors with an unknown controller."""
    rows: dict[str, list[float | None]] = {}
    for drives, lab in (("", bench.virtual), (FEEDBACK, bench.feedback)):
        least = lab.run("idim-ls", ACTUAL)
        runs = [lab.run("idim-iv", case) for case in (IMPULSE_RESPONSES, KNOWN_STRUCTURE)]
        rows[f"error, %{drives}"] = [least.error_pct, *(run.error_pct for run in runs)]
        rows[f"iterations{drives}"] = [None, *(iterations(run) for run in runs)]
    return figures("5.14", rows, [CONTROLLERS])


def _in_numbers(found: TwoStages | None) -> list[float | None]:
    """Return the figures in the order of ``IN_NUMBERS``; empty if the second stage did not converge."""
    if found is None:
        return [None] * len(IN_NUMBERS)
    return [found.distance, found.loop_pct, found.gain_pct, float(found.simulations), found.seconds]


TABLES: dict[str, TableFunction] = {
    "5.1": table_5_1,
    "5.2": table_5_2,
    "5.3": table_5_3,
    "5.4": table_5_4,
    "5.5": table_5_5,
    "5.6": table_5_6,
    "5.7": table_5_7,
    "5.8": table_5_8,
    "5.9": table_5_9,
    "5.10": table_5_10,
    "5.11": table_5_11,
    "5.12": table_5_12,
    "5.13": table_5_13,
    "5.14": table_5_14,
}
