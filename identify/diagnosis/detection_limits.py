"""Detection limits: smallest size of each effect that a diagnosis of these recordings would find."""

import numpy as np
from scipy.special import ndtri

from armident.arrays import Array
from armident.identify.diagnosis.candidate_comparison import SelectionStep
from armident.identify.diagnosis.candidates import Candidate, ColumnCache, Shapes, candidates
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.precision import variance_of_sum
from armident.identify.diagnosis.screening import orthogonal_directions
from armident.identify.documents.diagnosis import DetectionLimit
from armident.identify.effects.transmission import MotorOrder
from armident.identify.effects.unnamed import NAME as UNNAMED


def detection_limits(state: ModelState, step: SelectionStep | None) -> list[DetectionLimit]:
    """Return the detection limits of single linear parameters of effects that the final model lacks.

    At the limit, the gain reaches its threshold with `Criteria.detection_power`, and the joint's error falls by enough.
    """
    column_cache = ColumnCache(state.study, state.fit.theta)
    shapes = {} if step is None else {a.candidate.key: a.shapes for a in reversed(step.ranked)}
    named = [c for c in candidates(column_cache) if c.effect.name != UNNAMED and not c.effect.law]
    every = [c for c in named if c.effect.instrument_signals == "simulated"]
    found: list[DetectionLimit] = []
    for candidate in every:
        if isinstance(candidate.effect, MotorOrder) and candidate.key not in shapes:
            continue
        middle = candidate.grid[len(candidate.grid) // 2] if candidate.grid else ()
        sizes = _smallest(state, column_cache, candidate, shapes.get(candidate.key, middle), len(every))
        if sizes is not None and np.isfinite(sizes).any():
            found.append(_entry(state, candidate, sizes))
    return found


def _smallest(
    state: ModelState, column_cache: ColumnCache, candidate: Candidate, shapes: Shapes, tests: int
) -> Array | None:
    """Smallest detectable size (k,) of each linear parameter; infinite where it is not detectable."""
    fit, criteria = state.fit, state.study.criteria
    z = column_cache.instruments(candidate.effect, candidate.place, shapes, fit.noise, keep=False)
    basis = orthogonal_directions(fit, z)
    if basis is None:
        return None
    u, right, scale = basis
    able = np.linalg.norm(right, axis=1) > criteria.beyond_model_limit
    # Coordinates of each column in orthonormal directions beside the model.
    along = u.T @ z
    score = np.sqrt(2.0 * criteria.needed_gain(tests)) + float(ndtri(criteria.detection_power))
    residual = fit.residual
    rows = fit.regression.rows_of
    sizes = np.full(scale.size, np.inf)
    for k in np.flatnonzero(able):
        own = u @ along[:, k]
        size = float(own @ own)
        if size == 0.0:
            continue
        inflation = max(1.0, variance_of_sum(own * residual) / size)
        powers = np.array([[float(of[r] @ of[r]) for of in (residual, own)] for r in rows])
        share = criteria.least_share * float(np.min(powers[:, 0] / np.maximum(powers[:, 1], 1e-300)))
        sizes[k] = max(score * np.sqrt(inflation / size), np.sqrt(share))
    return sizes


def _entry(state: ModelState, candidate: Candidate, sizes: Array) -> DetectionLimit:
    joints, place = state.study.joints, candidate.place
    kind = int(state.study.robot.joints[place.joint].type == "prismatic")
    finite = [(p, float(v)) for p, v in zip(candidate.effect.linear, sizes, strict=True) if np.isfinite(v)]
    return DetectionLimit(
        effect=candidate.effect.name,
        joint=joints[place.joint],
        other=None if place.other is None else joints[place.other],
        limits={p.name: float(f"{v:.2g}") for p, v in finite},
        units={p.name: p.unit[kind] for p, _ in finite},
    )
