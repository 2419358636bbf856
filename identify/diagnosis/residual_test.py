"""Test of the residuals of an identification against those of the baseline, which describe what the model lacks.

Free functions of the motion are tested by the difference of coefficients, bands of frequency by the ratio of powers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtrc, fdtr, fdtrc

from armident.arrays import Array
from armident.identify.documents.identification import IdentificationDocument, ResidualStatistics
from armident.identify.documents.rounding import chance
from armident.identify.regression.multiple_testing import holm

SAME_MOTION = 0.1
"""Largest difference of range and speed of a joint between both runs, as share of them. The model errors of a healthy
arm cancel in the difference only if the motion of all joints is the same.
A shift of an eighth of the range would be one knot of the functions of position."""

RANK = 1e-3
"""Eigenvalue of the information of normalised functions, relative to the largest, below which a combination of
functions is left out: base parameters explain it, or the motion does not show it. Its standard deviation is more than
thirty times that of the best determined one."""

NOT_COMPARED = (
    "structure is not compared: the baseline has no statistics of the residuals; "
    "renew it: armident identify RECORDING of the baseline, then --baseline its identification.json"
)


@dataclass(frozen=True)
class ResidualChange:
    """Test of one property of a joint's residuals, by chi-square or a ratio of powers; p-value corrected by Holm."""

    joint: str
    kind: Literal["position", "velocity", "power"]
    statistic: float
    degrees: float
    p_value: float
    band_hz: tuple[float, float] | None = None

    @property
    def words(self) -> str:
        """Result in one sentence, which begins with the joint."""
        p = chance(self.p_value)
        if self.band_hz is not None:
            low, high = self.band_hz
            return f"{self.joint}: power of the residuals from {low:.3g} to {high:.3g} Hz x {self.statistic:.3g}, {p}"
        of = "position and direction" if self.kind == "position" else "velocity"
        return (
            f"{self.joint}: dependence of the residuals on {of} has changed "
            f"(chi-square {self.statistic:.1f} of {self.degrees:.0f} degrees of freedom), {p}"
        )


@dataclass(frozen=True)
class ResidualTest:
    """Test of all joints and kinds; ``reason``: why structure is not compared."""

    tests: tuple[ResidualChange, ...] = ()
    reason: str = ""

    def changed(self, level: float) -> tuple[ResidualChange, ...]:
        """Return the significant changes, the most significant first. ``level``: False-alarm rate of the whole test."""
        return tuple(sorted((t for t in self.tests if t.p_value < level), key=lambda t: t.p_value))


def unchanged(joint: int) -> Array | float:
    """No change of the scores of a joint."""
    return 0.0


def compare_residuals(
    baseline: IdentificationDocument,
    now: IdentificationDocument,
    predicted: Callable[[int], Array | float] = unchanged,
) -> ResidualTest:
    """Test the residuals of two identifications of an arm with the same motion for a change.

    ``predicted``: change of the scores (k,) of each joint that is explained already. The power of such a joint is not
    tested: it contains the explained torque.
    """
    if baseline.residual_statistics is None:
        return ResidualTest(reason=NOT_COMPARED)
    if now.residual_statistics is None:
        return ResidualTest(reason="structure is not compared: this run has no statistics of the residuals")
    before = {each.joint: each for each in baseline.residual_statistics}
    pairs = [
        (before[e.joint], _less(e, predicted(j))) for j, e in enumerate(now.residual_statistics) if e.joint in before
    ]
    other = [new.joint for old, new in pairs if not _same_motion(old, new)]
    if other:
        return ResidualTest(
            reason=f"structure is not compared: the motion of {', '.join(other)} is not that of the baseline"
        )
    variance = _variance(baseline, now)
    tests = [test for old, new in pairs for test in _tests(old, new, variance)]
    corrected = holm(np.array([test.p_value for test in tests])) if tests else np.empty(0)
    return ResidualTest(
        tuple(
            ResidualChange(t.joint, t.kind, t.statistic, t.degrees, float(p), t.band_hz)
            for t, p in zip(tests, corrected, strict=True)
        )
    )


def _less(new: ResidualStatistics, predicted: Array | float) -> ResidualStatistics:
    """Statistics without a change of the scores that is explained."""
    if not np.any(predicted):
        return new
    score = list(np.array(new.score) - predicted)
    return new.model_copy(update={"score": score, "band_power": [0.0] * len(new.band_power)})


def _same_motion(old: ResidualStatistics, new: ResidualStatistics) -> bool:
    width = old.position_range[1] - old.position_range[0]
    moved = np.abs(np.subtract(old.position_range, new.position_range)).max()
    return bool(
        moved <= SAME_MOTION * width
        and abs(old.velocity_limit - new.velocity_limit) <= SAME_MOTION * old.velocity_limit
    )


def _variance(baseline: IdentificationDocument, now: IdentificationDocument) -> float:
    """Variance of a difference over that of the baseline's coefficient: a shorter run determines them less well."""
    before, after = (
        sum(each.samples for each in (document.recording, *(document.further_recordings or ())))
        for document in (baseline, now)
    )
    return 1.0 + before / after if before and after else 2.0


def _tests(old: ResidualStatistics, new: ResidualStatistics, variance: float) -> list[ResidualChange]:
    """Tests of one joint; their p-values are not corrected. Bands are left out if their limits differ."""
    k = len(new.score)
    split = 2 * k // 3
    found = []
    kinds: Sequence[tuple[Literal["position", "velocity"], slice]] = (
        ("position", slice(0, split)),
        ("velocity", slice(split, k)),
    )
    for kind, part in kinds:
        value, degrees = _functions(old, new, part, variance)
        chance = float(chdtrc(degrees, value)) if degrees else 1.0
        found.append(ResidualChange(new.joint, kind, value, degrees, chance))
    if not np.allclose(old.band_edges_hz, new.band_edges_hz, rtol=1e-3):
        return found
    rows = zip(
        old.band_power,
        old.band_degrees,
        new.band_power,
        new.band_degrees,
        new.band_edges_hz,
        new.band_edges_hz[1:],
        strict=False,
    )
    for p0, d0, p1, d1, low, high in rows:
        if p0 <= 0.0 or p1 <= 0.0:
            continue
        chance = min(1.0, 2.0 * float(min(fdtrc(d1, d0, p1 / p0), fdtr(d1, d0, p1 / p0))))
        found.append(ResidualChange(new.joint, "power", p1 / p0, d1, chance, (low, high)))
    return found


def _functions(old: ResidualStatistics, new: ResidualStatistics, part: slice, variance: float) -> tuple[float, int]:
    """Chi-square of the difference of the coefficients of some functions, and its degrees of freedom."""
    target, _ = _whitened_functions(old, new, part, variance)
    return float(target @ target), target.size


def _whitened_functions(
    old: ResidualStatistics, new: ResidualStatistics, part: slice, variance: float
) -> tuple[Array, Array]:
    """Whitened difference (r,) of the coefficients of some functions, and its change (r, k) per score of ``new``.

    The noise of the baseline counts for both: a noise model of a changed arm would absorb a part of the change.
    """
    information = [np.array(each.information)[part, part] for each in (old, new)]
    score = [np.array(each.score)[part] for each in (old, new)]
    scale = np.sqrt(np.maximum(np.diag(information[0]), 1e-300))
    values, vectors = np.linalg.eigh(information[0] / np.outer(scale, scale))
    if values[-1] <= 0.0:
        return np.zeros(0), np.zeros((0, scale.size))
    kept = vectors[:, values > RANK * values[-1]] / scale[:, None]
    before, now = (kept.T @ each @ kept for each in information)
    root = np.linalg.cholesky(before).T / np.sqrt(variance)
    change = root @ np.linalg.pinv(now, hermitian=True) @ kept.T
    return change @ score[1] - root @ np.linalg.solve(before, kept.T @ score[0]), change


def residual_difference(baseline: IdentificationDocument, now: IdentificationDocument) -> list[tuple[Array, Array]]:
    """Whitened difference of the functions of every joint, and its change per score; empty for another motion."""
    before = {each.joint: each for each in baseline.residual_statistics or ()}
    same = same_motion(baseline, now)
    return [
        _whitened_functions(before[each.joint], each, slice(None), _variance(baseline, now))
        if same
        else (np.zeros(0), np.zeros((0, len(each.score))))
        for each in now.residual_statistics or ()
    ]


def same_motion(baseline: IdentificationDocument, now: IdentificationDocument) -> bool:
    """True if all joints moved alike in both runs, as far as the documents tell."""
    before = {each.joint: each for each in baseline.residual_statistics or ()}
    return all(e.joint in before and _same_motion(before[e.joint], e) for e in now.residual_statistics or ())
