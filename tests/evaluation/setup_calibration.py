"""Calibration of the set-up check: ``python -m tests.evaluation.setup_calibration --arms 64 --cases 8 --out FILE``.

Every finding of the check is compared with the truth of `setup_cases`. Each line of FILE is one recording; a stopped
run continues. Without ``--arms`` the file is evaluated: the coefficients of `setup.calibration` with those of all arms,
and the table of printed probabilities, each of an arm that had no part in its coefficients. Only arms of the
development half are drawn.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.special import expit

from armident.configs import DataError
from armident.identify.setup import check, judge
from armident.identify.setup.calibration import CORRECTED, EXTREMES, FEATURES
from armident.identify.setup.contest import same_correction
from armident.identify.setup.describe import Described
from tests.evaluation.setup_cases import SetupCase, cases
from tests.tools.markdown import table

Floats = NDArray[np.float64]

MOST_JOINTS = 5
"""Largest number of joints of the arms: the check of seven takes ten times as long."""
FOLDS = 8
"""Groups of arms; the findings of each are judged by coefficients of the others."""
RIDGE = 0.5
"""Weight of the squared coefficients of standardised features, in findings."""
BINS = (0.0, 0.5, 0.9, 0.95, 0.99, 1.0)
"""Edges of the printed probabilities in the table."""


def measured(case: SetupCase) -> dict[str, Any]:
    """Findings of a case with features, and whether each is right."""
    found: list[dict[str, Any]] = []
    given = judge.judged_part

    def kept(part: Described, contest: Any, robot: Any) -> Described:
        made = given(part, contest, robot)
        finding, joints = made.finding, judge.indices(part.finding.joints, robot)
        if not part.finding.decisive:
            return made
        equal = contest.equal(finding.kind, joints)
        found.append(
            {
                "kind": finding.kind,
                "right": any(
                    same_correction(finding.kind, joints, step.h, case.truth, each_own=contest.each_own)
                    for step in (contest.found, *equal)
                ),
                "explains": judge.explains(finding.kind, contest, joints),
                "x": contest.features(contest.log_odds(finding.kind, joints, equal)).tolist(),
            }
        )
        return made

    row: dict[str, Any] = {"arm": case.arm, "joints": case.robot.n, "family": case.family, "kind": case.kind}
    begin = time.process_time()
    judge.judged_part = kept
    try:
        check.check_setup(case.experiments, case.robot)
    except DataError as error:
        row["refused"] = str(error)
    finally:
        judge.judged_part = given
    return row | {"cpu_s": time.process_time() - begin, "findings": found}


def measure(arms: int, count: int, file: Path) -> None:
    """Check the cases of the arms and append a line for each to the file."""
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    done = {row["number"] for row in rows}
    with file.open("a") as out:
        for arm in range(arms):
            for k, case in enumerate(cases(arm, count)):
                number = f"{arm}.{k}"
                if case.robot.n > MOST_JOINTS:
                    break
                if number not in done:
                    out.write(json.dumps({"number": number} | measured(case)) + "\n")
                    out.flush()


def fitted(x: Floats, right: Floats) -> tuple[Floats, float]:
    """Coefficients and intercept of a logistic map with a ridge. ``x``: features (F, k)."""
    centre, size = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-9)
    z = np.column_stack([np.ones(len(x)), (x - centre) / size])

    def loss(w: Floats) -> tuple[float, Floats]:
        p = z @ w
        value = np.logaddexp(0.0, p).sum() - right @ p + 0.5 * RIDGE * w[1:] @ w[1:]
        slope = z.T @ (expit(p) - right)
        slope[1:] += RIDGE * w[1:]
        return float(value), slope

    w = optimize.minimize(loss, np.zeros(z.shape[1]), jac=True, method="L-BFGS-B").x
    return w[1:] / size, float(w[0] - (w[1:] / size) @ centre)


def cross_fitted(x: Floats, right: Floats, arms: NDArray[np.int64]) -> Floats:
    """Probability of every finding by the coefficients of the other groups of arms."""
    p = np.zeros(len(x))
    for fold in range(FOLDS):
        own = arms % FOLDS == fold
        if own.any():
            coefficients, intercept = fitted(x[~own], right[~own])
            p[own] = np.clip(expit(x[own] @ coefficients + intercept), *EXTREMES)
    return p


def expected_error(p: Floats, right: Floats) -> float:
    """Expected calibration error: mean difference of printed and right shares over `BINS`."""
    inside = np.clip(np.digitize(p, BINS) - 1, 0, len(BINS) - 2)
    return float(sum(abs((p - right)[inside == b].sum()) for b in range(len(BINS) - 1)) / len(p))


def evaluate(file: Path) -> str:
    """Coefficients, and the table of printed probabilities, as text."""
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    found = [(f, row) for row in rows for f in row["findings"]]
    x = np.array([f["x"] for f, _ in found])
    right = np.array([f["right"] for f, _ in found], np.float64)
    arms = np.array([row["arm"] for _, row in found])
    explains = np.array([f["explains"] for f, _ in found])
    coefficients, intercept = fitted(x, right)
    p = cross_fitted(x, right, arms)
    lines = [f'    "{name}": {value:.3f},' for name, value in zip(FEATURES, coefficients, strict=True)]
    inside = np.clip(np.digitize(p, BINS) - 1, 0, len(BINS) - 2)
    cells = [
        [f"{BINS[b]:g} to {BINS[b + 1]:g}", str(int(own.sum())), f"{p[own].mean():.3f}", f"{right[own].mean():.3f}"]
        for b in range(len(BINS) - 1)
        if (own := inside == b).any()
    ]
    copied = (p > CORRECTED) & explains
    missed = int((~copied & (right > 0)).sum())
    return "\n".join(
        [
            *lines,
            f"INTERCEPT = {intercept:.3f}",
            "",
            table(["printed", "findings", "mean printed", "right"], cells),
            "",
            f"{len(rows)} recordings of {len(set(arms.tolist()))} arms with a finding, {len(found)} findings, "
            f"ECE {expected_error(p, right):.3f}; corrections to copy: {int(copied.sum())}, "
            f"of them right {right[copied].mean():.3f}; right findings without one: {missed}",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, or evaluate what was measured."""
    parser = argparse.ArgumentParser(prog="python -m tests.evaluation.setup_calibration", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="File of JSON lines.")
    parser.add_argument("--arms", type=int, default=0, help="Number of arms; 0 evaluates the file.")
    parser.add_argument("--cases", type=int, default=8, help="Recordings of each arm.")
    options = parser.parse_args(arguments)
    if options.arms:
        measure(options.arms, options.cases, options.out)
    print(evaluate(options.out))


if __name__ == "__main__":
    main()
