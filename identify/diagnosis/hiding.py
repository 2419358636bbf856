"""Detection limits: smallest size of each effect that a diagnosis of these recordings would find."""

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.identify.diagnosis.candidates import Candidate, Columns, Shapes, candidates
from armident.identify.diagnosis.state import HELD_OUT_LEVEL, Settings, State
from armident.identify.diagnosis.trial import deviations, inflation_along, joints_reached
from armident.identify.diagnosis.whitening import rows_of_joints, whitened
from armident.identify.document import DetectionLimit

Array = NDArray[np.float64]

POWER = 0.9
"""Probability of detection at the detection limit."""


def detection_limits(state: State, settings: Settings) -> list[DetectionLimit]:
    """Return the detection limits of the effects that are not in the model.

    Each linear parameter is treated by itself, at the nonlinear parameters that fit best. At the limit, training and
    held-out tests are both significant at the levels of the search with probability `POWER`, and the held-out error
    falls by the share that a finding requires.

    Parameters
    ----------
    state
        Model with all findings.
    settings
        Error rates of the search.
    """
    shapes = {trial.candidate.key: trial.shapes for trial in (*state.others, *state.trials[::-1])}
    found: list[DetectionLimit] = []
    for candidate in candidates(state.workshop):
        if candidate.key in state.hidden or candidate.effect.sudden:
            continue
        tried = shapes.get(candidate.key, candidate.grid[len(candidate.grid) // 2] if candidate.grid else ())
        sizes = _smallest(state, candidate, tried, settings)
        if sizes is not None and np.isfinite(sizes).any():
            found.append(_told(state, candidate, sizes))
    return found


def _smallest(state: State, candidate: Candidate, shapes: Shapes, settings: Settings) -> Array | None:
    """Smallest detectable size (k,) of each linear parameter; infinite where it is not detectable."""
    fit = state.fit
    # Columns at the simulated motion: they are in the cache, and the limit is that of a probability.
    z, held_z = (
        whitened(state.workshop.band(candidate.effect, candidate.place, shapes, part, "simulated"), fit.noise)
        for part in ("train", "held")
    )
    std = deviations(fit, Columns(z, z, held_z, held_z))
    if std is None:
        return None
    often = float(stats.norm.ppf(POWER))
    tests = max(state.tests, 1) * max(len(candidate.grid), 1)
    train = float(stats.norm.isf(0.5 * settings.false_alarms / tests)) + often
    held = float(stats.norm.isf(HELD_OUT_LEVEL)) + often
    residual = fit.held_residual
    change = held_z - np.stack([fit.held_at_simulated(a) for a in fit.absorbed(z).T], axis=1)
    rows = rows_of_joints([s.y.shape[0] for s in fit.study.held], fit.noise)
    sizes = np.full(std.size, np.inf)
    for k in np.flatnonzero(std > 0.0):
        own = change[:, k]
        size = float(own @ own)
        if size == 0.0:
            continue
        inflation = inflation_along(own, residual)
        spread = np.sqrt(size * inflation + fit.spread(own)) / size
        reached = joints_reached(candidate, own, rows)
        powers = np.array([[float(of[r] @ of[r]) for of in (residual, own)] for r in reached])
        share = np.sqrt(settings.material * float(np.min(powers[:, 0] / np.maximum(powers[:, 1], 1e-300))))
        sizes[k] = max(train * std[k] * np.sqrt(inflation), held * spread, share)
    return sizes


def _told(state: State, candidate: Candidate, sizes: Array) -> DetectionLimit:
    joints, place = state.study.joints, candidate.place
    kind = int(state.study.robot.joints[place.joint].type == "prismatic")
    named = [(p, float(v)) for p, v in zip(candidate.effect.linear, sizes, strict=True) if np.isfinite(v)]
    return DetectionLimit(
        effect=candidate.effect.name,
        joint=joints[place.joint],
        other=None if place.other is None else joints[place.other],
        limits={p.name: float(f"{v:.2g}") for p, v in named},
        units={p.name: p.unit[kind] for p, _ in named},
    )
