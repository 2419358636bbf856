"""Time shift between all torques and the positions, in fractions of a sample, estimated with instruments (thesis 2.33).

At low rates half a sample changes the residual as much as an effect. A torque that is late by ``s`` is, to first order,
``phi theta - s d(phi theta)/dt``. A disturbance moves the arm before the torque of the closed loop, so instruments are
regressors of filtered references. A joint stops suddenly, and leaves standstill slowly: the change of friction is free.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.regression.ar_noise import ArModel, fit_ar
from armident.identify.setup.bench import Bench, make_bench
from armident.identify.setup.fit import Hypothesis
from armident.identify.setup.result import CONVENTIONS, TorqueShift
from armident.identify.signals.experiments import Experiment

Motion = tuple[Array, Array, Array]

SHIFT_RATE = 20.0
"""Rate of the derivatives over the cut-off: central differences then err by 3 % at the cut-off itself."""

MOST_SAMPLES = 8000
"""Largest number of samples at the working rate: 20 s of six axes at 400 Hz. The first part of longer recordings."""

MAX_AR_ORDER = 10
"""Highest order of the noise models after decimation."""

PASSES = 2
"""Fits with noise models, after the first one without."""

RANK = 1e-6
"""Singular value of the normalised regressor, relative to the largest, from which a direction counts as excited."""

LAGS = 16
"""Coefficients of the filter from reference to motion: eight closed-loop periods at the rate of the rows."""

RANGE = 5.0
"""Largest shift, samples: longer ones are mistakes of the set-up."""

LONGEST_SHIFT_S = 0.05
"""Longest of these, and of a shift with a cause of its own at one joint, s: filters of drives are faster."""

ROUNDS = 12
"""Most rounds in which a longer shift is estimated again around the value of the round before."""

CONVERGED = 0.1
"""Change from round to round, standard deviations, below which the rest does not matter."""

STEPS = 2001
"""Values of the shift between these limits: a two-hundredth of a sample apart."""

OWN_CAUSE = 0.2
"""Prior share of joints whose apparent shift has a cause of its own: at most one joint in five lacks an effect."""

LARGE = 700.0
"""Largest logarithm of odds that is a finite number."""

WIDTHS = (0.02, 0.005)
"""Shares of a joint's largest velocity over which the smoothed signs of its dry friction change."""

BREAKAWAY = 0.1
"""Share of a joint's largest velocity over which its friction of low velocities decays."""


@dataclass(frozen=True, eq=False)
class _Columns:
    """Regressors of one joint per segment: filtered and decimated (M, c), and ``fine`` at the working rate (W, c)."""

    rows: list[Array]
    fine: list[Array]


def long_torque_shift(
    experiments: Sequence[Experiment], bench: Bench, h: Hypothesis, first_s: float, reach_s: float
) -> TorqueShift | None:
    """Estimate a common shift of many samples; ``None`` where none is determined within ``reach_s`` of ``first_s``.

    The estimate is linear: it is repeated with torques moved by the last value until that changes no more.
    """
    first, reach = first_s / bench.period, reach_s / bench.period
    shift = first
    for _ in range(ROUNDS):
        try:
            found = _estimated(experiments, bench, h, shift)
            rest = _common(found, max(RANGE, reach, LONGEST_SHIFT_S / bench.period))
            experiments = _first_part(experiments, round(MOST_SAMPLES * found.bench.segments[0].dt / bench.period))
        except (DataError, np.linalg.LinAlgError):
            return None
        shift += rest.samples
        if abs(shift - first) > reach:
            return None
        if abs(rest.samples) <= CONVERGED * rest.std:
            break
    before = shift - rest.samples
    by_joint = {name: (value + before, std) for name, (value, std) in rest.by_joint.items()}
    return replace(rest, samples=shift, by_joint=by_joint)


def common_shift(experiments: Sequence[Experiment], bench: Bench, h: Hypothesis) -> TorqueShift:
    """Estimate the common shift of the torques, and each joint's, up to `RANGE` samples; DataError or LinAlgError."""
    return _common(_estimated(experiments, bench, h, 0.0), RANGE)


@dataclass(frozen=True, eq=False)
class _Shifts:
    """Shift of each moving joint, samples, with covariance, and the bench of the equations."""

    samples: Array
    covariance: Array
    bench: Bench
    instrumented: bool


def _estimated(experiments: Sequence[Experiment], bench: Bench, h: Hypothesis, shift: float) -> _Shifts:
    """Shifts that torques have that are moved by ``shift`` samples; those of a bench are estimated once."""
    parts = (h.position, h.torque, h.gravity, h.shift, h.clock, shift, [e.q.shape[0] for e in experiments])
    key = b"".join(np.asarray(part).tobytes() for part in parts)
    if key not in bench.shifts:
        moved = [replace(e, torque_shift=e.torque_shift + shift) for e in experiments]
        bench.shifts[key] = _shifts(make_bench(moved, bench.robot, bench.moving, SHIFT_RATE, bench), h)
    found: _Shifts = bench.shifts[key]
    return found


def _shifts(bench: Bench, h: Hypothesis) -> _Shifts:
    """Shifts of a bench with the working rate `SHIFT_RATE`."""
    segments = _shortened(bench)
    joints = [int(j) for j in np.flatnonzero(bench.moving)]
    instrumented = all(s.q_ref is not None for s in segments.segments)
    measured = _columns(segments, h, [(s.q, s.qd, s.qdd) for s in segments.segments])
    followed = _columns(segments, h, _followed(segments)) if instrumented else measured
    y = [bench.decimation(s.tau @ h.torque.T) for s in segments.segments]
    basis = _excited([np.concatenate(measured[j].rows) for j in joints], [_scale(y, j) for j in joints])
    noise = [ArModel(np.empty(0), 1.0 / _scale(y, j) ** 2, 0.0) for j in joints]
    theta, covariance = np.zeros(basis.shape[1]), np.empty((0, 0))
    for done in range(PASSES + 1):
        shifts = len(joints) if done else 0

        def block(columns: _Columns, k: int, theta: Array = theta, shifts: int = shifts) -> list[Array]:
            return [
                np.hstack([r @ basis, _late(bench, f @ (basis @ theta[: basis.shape[1]]), k, shifts)])
                for r, f in zip(columns.rows, columns.fine, strict=True)
            ]

        x = [block(measured[j], k) for k, j in enumerate(joints)]
        z = [block(followed[j], k) for k, j in enumerate(joints)] if instrumented else x
        theta, covariance = _solved(z, x, [[v[:, j] for v in y] for j in joints], noise)
        noise = [
            fit_ar([v[:, j] - own @ theta for v, own in zip(y, x[k], strict=True)], MAX_AR_ORDER)
            for k, j in enumerate(joints)
        ]
    c, samples = basis.shape[1], segments.period
    return _Shifts(theta[c:] / samples, covariance[c:, c:] / samples**2, segments, instrumented)


def _first_part(experiments: Sequence[Experiment], samples: int) -> Sequence[Experiment]:
    """Experiments shortened alike to a number of samples together."""
    share = samples / sum(e.q.shape[0] for e in experiments)
    if share >= 1.0:
        return experiments
    kept = [max(round(share * e.q.shape[0]), 1) for e in experiments]
    return [
        replace(e, q=e.q[:k], tau=e.tau[:k], q_ref=None if e.q_ref is None else e.q_ref[:k])
        for e, k in zip(experiments, kept, strict=True)
    ]


def _shortened(bench: Bench) -> Bench:
    total = sum(s.q.shape[0] for s in bench.segments)
    if total <= MOST_SAMPLES:
        return bench
    least = 2 * bench.decimation.taps.size
    kept = [max(int(s.q.shape[0] * MOST_SAMPLES / total), least) for s in bench.segments]
    cut = [
        replace(s, q=s.q[:k], qd=s.qd[:k], qdd=s.qdd[:k], tau=s.tau[:k], q_ref=None if s.q_ref is None else s.q_ref[:k])
        for s, k in zip(bench.segments, kept, strict=True)
    ]
    return replace(bench, segments=tuple(cut))


def _columns(bench: Bench, h: Hypothesis, motions: Sequence[Motion]) -> list[_Columns]:
    """Regressors of every joint: rigid arm, then the free friction terms of all joints."""
    n, model = bench.n, bench.model.with_gravity(h.gravity)
    dry = [bench.column(f"fc{j + 1}") for j in range(n)]
    top = np.maximum(np.max([np.abs(s.qd @ h.position.T).max(axis=0) for s in bench.segments], axis=0), 1e-12)
    found = [_Columns([], []) for _ in range(n)]
    for motion, segment in zip(motions, bench.segments, strict=True):
        q, qd, qdd = (np.ascontiguousarray(v @ h.position.T) for v in motion)
        x = model.rigid_regressor(q, qd, qdd)
        x[:, :, dry] = 0.0
        filtered = bench.decimation(x)
        friction = _friction(qd, top, segment.dt)
        terms, low = friction.shape[2], bench.decimation(friction)
        for j in range(n):
            for into, rigid, own in ((found[j].fine, x, friction), (found[j].rows, filtered, low)):
                columns = np.zeros((rigid.shape[0], bench.rigid + terms * n))
                columns[:, : bench.rigid] = rigid[:, j]
                columns[:, bench.rigid + terms * j : bench.rigid + terms * (j + 1)] = own[:, j]
                into.append(columns)
    return found


def _friction(qd: Array, top: Array, dt: float) -> Array:
    """Free friction terms (W, n, .): dry, its change with time, asymmetric viscous, quadratic, at low velocity."""
    u = qd / top
    signs = [2 / np.pi * np.arctan(u / width) for width in WIDTHS]
    changes = [np.gradient(sign, dt, axis=0) for sign in signs]
    others = [np.abs(u), u * np.abs(u), signs[0] * np.exp(-np.abs(u) / BREAKAWAY)]
    return np.stack([*signs, *changes, *others], axis=2)


def _followed(bench: Bench) -> list[Motion]:
    """Motions that a linear filter makes of the references, with its coefficients fitted to each joint."""
    step = bench.decimation.factor
    lagged = []
    for s in bench.segments:
        assert s.q_ref is not None
        padded = np.concatenate([np.repeat(s.q_ref[:1], step * LAGS, axis=0), s.q_ref])
        parts = [padded[step * (LAGS - k) :][: s.q.shape[0]] for k in range(LAGS)]
        lagged.append(np.stack([*parts, np.ones_like(s.q)], axis=2))
    followed = [np.empty_like(s.q) for s in bench.segments]
    for j in range(bench.n):
        taps = np.linalg.lstsq(
            np.concatenate([v[:, j] for v in lagged]),
            np.concatenate([s.q[:, j] for s in bench.segments]),
            rcond=1e-8,
        )[0]
        for q, v in zip(followed, lagged, strict=True):
            q[:, j] = v[:, j] @ taps
    motions = []
    for q, s in zip(followed, bench.segments, strict=True):
        qd = np.gradient(q, s.dt, axis=0)
        motions.append((q, qd, np.gradient(qd, s.dt, axis=0)))
    return motions


def _scale(y: Sequence[Array], j: int) -> float:
    """One over the rms torque of a joint."""
    return float(1.0 / max(np.sqrt(np.mean(np.concatenate([v[:, j] for v in y]) ** 2)), 1e-300))


def _excited(x: Sequence[Array], scale: Sequence[float]) -> Array:
    """Combinations of columns, (c, r), that the motion excites."""
    scaled = np.concatenate([s * v for v, s in zip(x, scale, strict=True)])
    gram = scaled.T @ scaled
    norms = np.sqrt(np.diag(gram))
    used = norms > 1e-12 * norms.max()
    values, vectors = np.linalg.eigh(gram[np.ix_(used, used)] / np.outer(norms[used], norms[used]))
    kept = values > max(RANK**2, 1e-14) * values[-1]
    basis = np.zeros((norms.size, int(kept.sum())))
    basis[used] = vectors[:, kept] / norms[used, None]
    return basis


def _late(bench: Bench, torque: Array, k: int, shifts: int) -> Array:
    """Columns (M, shifts) of the delays: that of joint k holds the filtered change of its torque."""
    columns = np.zeros((bench.decimation.count(torque.shape[0]), shifts))
    if shifts:
        columns[:, k] = -bench.decimation(np.gradient(torque, bench.segments[0].dt)[:, None])[:, 0]
    return columns


def _solved(
    z: Sequence[Sequence[Array]], x: Sequence[Sequence[Array]], y: Sequence[Sequence[Array]], noise: Sequence[ArModel]
) -> tuple[Array, Array]:
    """Instrumental-variable estimate (2.33) of rows whitened by their noise, and its covariance.

    Noise may come in bursts, or with fast motion: the covariance is that of its own squares (White 1980, Econometrica
    48(4)).
    """
    parts = []
    for zeta, phi, tau, ar in zip(z, x, y, noise, strict=True):
        for a, b, t in zip(zeta, phi, tau, strict=True):
            wb = ar.whiten(b)
            parts.append((wb if a is b else ar.whiten(a), wb, ar.whiten(t)))
    inverse = np.linalg.inv(sum(wa.T @ wb for wa, wb, _ in parts))
    theta = inverse @ sum(wa.T @ wt for wa, _, wt in parts)
    rows, c = sum(wt.size for _, _, wt in parts), theta.size
    scores = [wa * (wt - wb @ theta)[:, None] for wa, wb, wt in parts]
    covariance = inverse @ sum(one.T @ one for one in scores) @ inverse.T * (rows / max(rows - c, 1))
    return theta, covariance


def _common(found: _Shifts, reach: float) -> TorqueShift:
    """Common shift of the joints; some have effects of their own that look like a shift, such as a slow actuator."""
    samples, variance, bench = found.samples, np.diag(found.covariance), found.bench
    if not (np.isfinite(samples).all() and np.all((variance > 0.0) & np.isfinite(variance))):
        raise np.linalg.LinAlgError("the motion determines no shift of the torques")
    std = np.sqrt(variance)

    def log_likelihood(shift: Array) -> Array:
        apart = (samples - shift[:, None]) / std
        common = np.exp(-0.5 * apart**2) / (std * np.sqrt(2 * np.pi))
        return np.asarray(np.log((1.0 - OWN_CAUSE) * common + OWN_CAUSE / (2 * reach)).sum(axis=1))

    grid = np.linspace(-reach, reach, STEPS)
    density = np.exp(log_likelihood(grid) - log_likelihood(grid).max())
    density /= density.sum()
    mean = float(density @ grid)
    held, instant = log_likelihood(np.array(CONVENTIONS))
    names = [bench.robot.joints[j].name for j in np.flatnonzero(bench.moving)]
    each = {name: (float(s), float(d)) for name, s, d in zip(names, samples, std, strict=True)}
    spread = float(np.sqrt(density @ (grid - mean) ** 2))
    return TorqueShift(mean, spread, bench.period, each, float(np.exp(min(instant - held, LARGE))), found.instrumented)
