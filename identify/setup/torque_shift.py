"""Time shift of less than two samples between all torques and positions, estimated with instruments (thesis 2.33)."""

from collections.abc import Sequence
from dataclasses import dataclass

import os

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.identify.regression.ar_noise import ArModel, fit_ar
from armident.identify.regression.equations import error_variances, serial_covariance, weighted_rows
from armident.identify.setup.bench import Bench, friction_terms
from armident.identify.setup.fit import Hypothesis

Array = NDArray[np.float64]

MAX_AR_ORDER = 10
PASSES = 3
RANK = float(os.environ.get("RANK","1e-4"))
LAGS = int(os.environ.get("LAGS","16"))


@dataclass(frozen=True)
class Estimated:
    samples: Array
    covariance: Array
    instrumented: bool


def estimate(bench: Bench, h: Hypothesis, free: bool = True) -> Estimated:
    joints = np.flatnonzero(bench.moving)
    n = bench.n
    model = bench.model.with_gravity(h.gravity)
    dry = [bench.column(f"fc{j + 1}") for j in range(n)]
    measured = [(s.q, s.qd, s.qdd) for s in bench.segments]
    top = np.maximum(np.max([np.abs(s.qd @ h.position.T).max(axis=0) for s in bench.segments], axis=0), 1e-12)

    def regressor(motion):
        q, qd, qdd = (np.ascontiguousarray(v @ h.position.T) for v in motion)
        x = model.rigid_regressor(q, qd, qdd)
        mode = os.environ.get('MODE', 'w')
        u = qd / top
        h_ = bench.segments[0].dt
        sharp = np.clip(qd / np.maximum(np.abs(qdd) * h_ / 2, 1e-9 * top), -1, 1)
        widths = [float(v) for v in os.environ.get('SLOW', '0.02').split(',')]
        f = [np.arctan(u / w_) * 2 / np.pi for w_ in widths]
        if 's' in mode:
            f.insert(0, sharp)
        f += [np.abs(u), u * np.abs(u), f[0] * np.exp(-np.abs(u) / 0.1)]
        if 'e' in mode:
            f += [f[0] * np.exp(-np.abs(u) / 0.03)]
        f = np.stack(f, axis=2)
        k_ = f.shape[2] - 1
        for j in range(n):
            x[:, :, dry[j]] = 0.0
            x[:, j, dry[j]] = f[:, j, 0]
        if free:
            extra = np.zeros((*x.shape[:2], k_ * n))
            for j in range(n):
                extra[:, j, k_ * j : k_ * (j + 1)] = f[:, j, 1:]
            x = np.concatenate([x, extra], axis=2)
        return x

    import os
    instrumented = not os.environ.get("LS") and all(s.q_ref is not None for s in bench.segments)
    full = [regressor(m) for m in measured]
    fullz = [regressor(m) for m in _followed(bench)] if instrumented else full
    y = [bench.decimation(s.tau @ h.torque.T) for s in bench.segments]
    keep = [np.ones(v.shape, dtype=np.bool_) & bench.moving for v in y]
    keep = [np.ascontiguousarray(k) for k in keep]
    # excited subspace
    x0 = [bench.decimation(v) for v in full]
    stacked = np.concatenate([v[:, joints].reshape(-1, v.shape[2]) for v in x0])
    # weights by torque power
    w = 1 / np.maximum(np.sqrt(np.mean(np.concatenate(y)[:, joints] ** 2, axis=0)), 1e-300)
    rows = np.concatenate([(v[:, joints] * w[:, None]).reshape(-1, v.shape[2]) for v in x0])
    norms = np.linalg.norm(rows, axis=0)
    used = norms > 1e-12 * norms.max()
    values, vectors = np.linalg.eigh((rows[:, used] / norms[used]).T @ (rows[:, used] / norms[used]))
    basis = np.zeros((norms.size, int((values > RANK**2 * values[-1]).sum())))
    basis[used] = vectors[:, values > RANK**2 * values[-1]] / norms[used, None]
    x = [v @ basis for v in x0]
    z = [bench.decimation(v) @ basis for v in fullz] if instrumented else x
    c = basis.shape[1]
    noise: Sequence[ArModel] = error_variances(y, keep, 0)
    theta = _solve(z, x, y, keep, noise)
    errors = [b - a @ theta for a, b in zip(x, y, strict=True)]
    noise = error_variances(errors, keep, c)
    theta = _solve(z, x, y, keep, noise)
    for _ in range(PASSES):
        xs = [_with_rates(a, f @ (basis @ theta[:c]), bench, joints) for a, f in zip(x, full, strict=True)]
        zs = xs if not instrumented else [
            _with_rates(a, f @ (basis @ theta[:c]), bench, joints) for a, f in zip(z, fullz, strict=True)
        ]
        theta = _solve(zs, xs, y, keep, noise)
        errors = [b - a @ theta for a, b in zip(xs, y, strict=True)]
        noise = [fit_ar([e[:, j] for e in errors], MAX_AR_ORDER) if bench.moving[j] else noise[j] for j in range(n)]
    theta = _solve(zs, xs, y, keep, noise)
    covariance = serial_covariance(zs, xs, keep, noise, noise)
    return Estimated(theta[c:] / bench.period, covariance[c:, c:] / bench.period**2, instrumented)


def _solve(z, x, y, keep, noise):
    zw, xw, yw = (weighted_rows(v, keep, noise) for v in (z, x, y))
    return np.linalg.solve(zw.T @ xw, zw.T @ yw)


def _with_rates(x, torque, bench, joints):
    dt = bench.segments[0].dt
    rate = bench.decimation(np.gradient(torque, dt, axis=0))
    own = np.zeros((*x.shape[:2], joints.size))
    own[:, joints, np.arange(joints.size)] = -rate[:, joints]
    return np.concatenate([x, own], axis=2)


def _followed(bench):
    """Motion that a linear filter of the references makes of them."""
    step = bench.decimation.factor
    lagged = []
    for s in bench.segments:
        first = np.repeat(s.q_ref[:1], step * LAGS, axis=0)
        padded = np.concatenate([first, s.q_ref])
        lagged.append(np.stack([padded[step * (LAGS - k) :][: s.q.shape[0]] for k in range(LAGS)], axis=2))
    motions = [np.empty_like(s.q) for s in bench.segments]
    for j in range(bench.n):
        a = np.concatenate([l[:, j] for l in lagged])
        b = np.concatenate([s.q[:, j] for s in bench.segments])
        a1 = np.column_stack([a, np.ones(a.shape[0])])
        coef = np.linalg.lstsq(a1, b, rcond=1e-8)[0]
        for m, l in zip(motions, lagged, strict=True):
            m[:, j] = l[:, j] @ coef[:-1] + coef[-1]
    out = []
    for m, s in zip(motions, bench.segments, strict=True):
        qd = np.gradient(m, s.dt, axis=0)
        out.append((m, qd, np.gradient(qd, s.dt, axis=0)))
    return out
