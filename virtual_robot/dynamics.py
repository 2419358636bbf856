"""Compiled integration of the arm over one control period: stiff friction inside, held torque outside."""

import math

import numpy as np
from numba import njit

from virtual_robot.effects import effect_torque

SUBSTEPS = 6
"""Inner steps per control period of 200 us: 33 us against the 50 us time constant of joint 6 at standstill."""

# ROS3: L-stable Rosenbrock method of order 3 (Sandu et al., Atmospheric Environment 31, 1997), two evaluations.
GAMMA = 0.43586652150845899941601945119356
C21, C31, C32 = -1.0156171083877702091975600115545, 4.0759956452537699824805835358067, 9.2076794298330791242156818474003
M2, M3 = 6.1697947043828245592553615689730, -0.42772256543218573326238373806514


@njit(cache=True, error_model="numpy")
def resist(q, qd, friction, smoothing, pairs, pair_friction, brake, ratio, code, joint, parameters, out, slope):  # type: ignore[no-untyped-def]
    """Friction, couplings (eq. B.1), brakes and hidden effects: torque ``out`` (n,) and ``slope`` (n, n).

    ``friction`` (n, 3) holds fv, fc and the offset; ``pairs`` (C, 2) and ``pair_friction`` (C, 2) the couplings.
    """
    n = q.size
    slope[:, :] = 0.0
    for i in range(n):
        x = smoothing * qd[i]
        out[i] = (friction[i, 0] + brake[i]) * qd[i] + friction[i, 1] * 2.0 / math.pi * math.atan(x) + friction[i, 2]
        slope[i, i] = friction[i, 0] + brake[i] + friction[i, 1] * 2.0 / math.pi * smoothing / (1.0 + x * x)
    for c in range(pairs.shape[0]):
        i, j = pairs[c, 0], pairs[c, 1]
        x = smoothing * (qd[i] + qd[j])
        dry = pair_friction[c, 1] * 2.0 / math.pi * math.atan(x)
        dry_slope = pair_friction[c, 1] * 2.0 / math.pi * smoothing / (1.0 + x * x)
        out[i] += pair_friction[c, 0] * qd[j] + dry
        out[j] += pair_friction[c, 0] * qd[i] + dry
        slope[i, i] += dry_slope
        slope[j, j] += dry_slope
        slope[i, j] += pair_friction[c, 0] + dry_slope
        slope[j, i] += pair_friction[c, 0] + dry_slope
    for e in range(code.size):
        j = joint[e]
        motor = 0.0
        for i in range(n):
            motor += ratio[j, i] * q[i]
        torque, steep = effect_torque(
            code[e], parameters[e], friction[j, 0], friction[j, 1], q[j], qd[j], motor, smoothing
        )
        out[j] += torque
        # A falling characteristic stays out of the matrix, which must remain positive definite.
        slope[j, j] += max(steep, 0.0) if steep > 0.0 else max(steep, -0.9 * slope[j, j])


@njit(cache=True, error_model="numpy")
def _factor(a):  # type: ignore[no-untyped-def]
    """Cholesky factor of ``a`` (n, n) in its lower triangle, in place; the diagonal is inverted."""
    n = a.shape[0]
    for j in range(n):
        s = a[j, j]
        for k in range(j):
            s -= a[j, k] * a[j, k]
        d = 1.0 / math.sqrt(s)
        a[j, j] = d
        for i in range(j + 1, n):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            a[i, j] = s * d


@njit(cache=True, error_model="numpy")
def _solve(a, x):  # type: ignore[no-untyped-def]
    """Solve with the factor of ``_factor``, in place."""
    n = x.size
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= a[i, k] * x[k]
        x[i] = s * a[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= a[k, i] * x[k]
        x[i] = s * a[i, i]


@njit(cache=True, error_model="numpy")
def advance(  # type: ignore[no-untyped-def]
    period,
    q,
    qd,
    middle,
    speed,
    tau,
    mass,
    bias,
    rotor,
    friction,
    smoothing,
    pairs,
    pair_friction,
    brake,
    ratio,
    code,
    joint,
    parameters,
):
    """Move ``q``, ``qd`` on by ``period`` under the held torque ``tau`` (all (n,)), in place.

    ``mass`` (upper triangle) and ``bias`` are Pinocchio's mass matrix and nonlinear effects at the predicted
    ``middle`` of the period; ``rotor`` (n, n) is added to the mass matrix. ``middle`` and ``speed`` get
    the positions and velocities predicted for the middle of the next period.
    """
    n = q.size
    full = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            full[i, j] = mass[i, j] + rotor[i, j]
            full[j, i] = full[i, j]
    force, slope, matrix = np.empty(n), np.empty((n, n)), np.empty((n, n))
    k1, k2, k3, x1, x2, x3 = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    q2, qd2, mk = np.empty(n), np.empty(n), np.empty(n)
    before = qd.copy()
    h = period / SUBSTEPS
    hg = h * GAMMA
    for _ in range(SUBSTEPS):
        resist(q, qd, friction, smoothing, pairs, pair_friction, brake, ratio, code, joint, parameters, force, slope)
        for i in range(n):
            for j in range(n):
                matrix[i, j] = full[i, j] / hg + slope[i, j]
            k1[i] = tau[i] - bias[i] - force[i]
        _factor(matrix)
        _solve(matrix, k1)
        for i in range(n):
            x1[i] = hg * (qd[i] + k1[i])
            q2[i] = q[i] + x1[i]
            qd2[i] = qd[i] + k1[i]
        resist(q2, qd2, friction, smoothing, pairs, pair_friction, brake, ratio, code, joint, parameters, force, slope)
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += full[i, j] * k1[j]
            mk[i] = s / h
            k2[i] = tau[i] - bias[i] - force[i] + C21 * mk[i]
        _solve(matrix, k2)
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += full[i, j] * k2[j]
            k3[i] = tau[i] - bias[i] - force[i] + C31 * mk[i] + C32 * s / h
        _solve(matrix, k3)
        for i in range(n):
            x2[i] = hg * (qd2[i] + k2[i] + C21 * x1[i] / h)
            x3[i] = hg * (qd2[i] + k3[i] + (C31 * x1[i] + C32 * x2[i]) / h)
            q[i] += x1[i] + M2 * x2[i] + M3 * x3[i]
            qd[i] += k1[i] + M2 * k2[i] + M3 * k3[i]
    for i in range(n):
        half = 0.5 * (qd[i] - before[i])
        speed[i] = qd[i] + half
        middle[i] = q[i] + 0.5 * period * (qd[i] + 0.5 * half)
