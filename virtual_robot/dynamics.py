"""Compiled integration of the arm over one control period, with constant torque and stiff friction.

Coordinates ``y`` (N,): motors, joint side (n,), then links behind elastic gears, then swinging masses.
"""

import math

import numpy as np

from armident.compiled import PLAIN, compiled
from armident.virtual_robot.effects.bristles import bristle_rate
from armident.virtual_robot.effects.forces import LOAD_CODE, effect_torque
from armident.virtual_robot.effects.gears import gear_torque

SUBSTEPS = 6
"""Inner steps per control period of 200 us: 33 us, below the time constant of 50 us of joint 6 at standstill."""

# ROS3: L-stable Rosenbrock method of order 3 (Sandu et al., Atmospheric Environment 31, 1997), two evaluations.
GAMMA = 0.43586652150845899941601945119356
C21, C31, C32 = -1.0156171083877702091975600115545, 4.0759956452537699824805835358067, 9.2076794298330791242156818474003
M2, M3 = 6.1697947043828245592553615689730, -0.42772256543218573326238373806514


@compiled(
    "f8[::1], f8[::1], f8, f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1]",
    **PLAIN,
)
def friction_torques(q, qd, t, friction, smoothing, pairs, ratio, table, load, out, slope):  # type: ignore[no-untyped-def]
    """Torques (N,) of friction, couplings (equation B.1), brakes and hidden effects, and slopes (N, N) over velocities.

    Written to ``out`` and ``slope``. ``friction`` (n, 4): fv, fc, offset, viscous brake. ``smoothing`` (n,): ``g`` in
    ``sign(qd) -> (2/pi) atan(g qd)``, s/rad or s/m. ``pairs`` (C, 4): two joints, fv and fc. ``table`` (E, 9):
    `force_table`. ``load`` (n,): of the gears on the links.
    """
    n = friction.shape[0]
    slope[:, :] = 0.0
    out[n:] = 0.0
    for i in range(n):
        x = smoothing[i] * qd[i]
        out[i] = (
            (friction[i, 0] + friction[i, 3]) * qd[i] + friction[i, 1] * 2.0 / math.pi * math.atan(x) + friction[i, 2]
        )
        slope[i, i] = friction[i, 0] + friction[i, 3] + friction[i, 1] * 2.0 / math.pi * smoothing[i] / (1.0 + x * x)
    for c in range(pairs.shape[0]):
        i, j = int(pairs[c, 0]), int(pairs[c, 1])
        g = min(smoothing[i], smoothing[j])
        x = g * (qd[i] + qd[j])
        dry = pairs[c, 3] * 2.0 / math.pi * math.atan(x)
        dry_slope = pairs[c, 3] * 2.0 / math.pi * g / (1.0 + x * x)
        out[i] += pairs[c, 2] * qd[j] + dry
        out[j] += pairs[c, 2] * qd[i] + dry
        slope[i, i] += dry_slope
        slope[j, j] += dry_slope
        slope[i, j] += pairs[c, 2] + dry_slope
        slope[j, i] += pairs[c, 2] + dry_slope
    for e in range(table.shape[0]):
        code, j, other = int(table[e, 0]), int(table[e, 1]), int(table[e, 2])
        motor = 0.0
        for i in range(n):
            motor += ratio[j, i] * q[i]
        beside = 0.0 if other < 0 else qd[other]
        torque, steep = effect_torque(code, table[e, 3:], q[j], qd[j], motor, beside, load[j], t, smoothing[j])
        out[j] += torque
        # Negative slopes are limited, because the matrix must remain positive definite.
        slope[j, j] += max(steep, 0.0) if steep > 0.0 else max(steep, -0.9 * slope[j, j])


@compiled("f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1]", **PLAIN)
def gear_torques(q, qd, gears, out, slope, stiff):  # type: ignore[no-untyped-def]
    """Add the torques (N,) of elastic gears and their slopes (N, N) over velocities and coordinates, in place.

    ``q``, ``qd`` (N,): coordinates and velocities; ``gears`` (G, 6): `gear_rows`.
    """
    for e in range(gears.shape[0]):
        a, b = int(gears[e, 0]), int(gears[e, 1])
        twist, rate = q[a], qd[a]
        if b >= 0:
            twist -= q[b]
            rate -= qd[b]
        torque, steep, damping = gear_torque(gears[e], twist, rate)
        out[a] += torque
        slope[a, a] += damping
        stiff[a, a] += steep
        if b >= 0:
            out[b] -= torque
            slope[b, b] += damping
            stiff[b, b] += steep
            slope[a, b] -= damping
            stiff[a, b] -= steep
            slope[b, a] -= damping
            stiff[b, a] -= steep


@compiled(**PLAIN)
def _factor(a):  # type: ignore[no-untyped-def]
    """Cholesky factor of ``a`` (n, n) in its lower triangle, in place, with inverted diagonal."""
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


@compiled(**PLAIN)
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


@compiled(
    "f8, i8, f8, f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[::1], "
    "f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1]",
    **PLAIN,
)
def advance(  # type: ignore[no-untyped-def]
    period, substeps, t, state, z, tau, mass, bias, rotor, link,
    friction, smoothing, pairs, ratio, table, load, gears, bristles,
):  # fmt: skip
    """Integrate the state over one period, s, with constant joint torque (n,) (ROS3), in place.

    ``state`` (4, N): position, velocity, and both as predicted for the middle of the next period; ``z`` (B,):
    deflection of the bristles. ``mass`` (upper triangle) and ``bias`` are Pinocchio's at the predicted middle, of the
    coordinates ``link``; ``rotor`` (N, N) are further inertias. ``bristles`` (B, 7): `bristle_table`; the others as in
    `friction_torques` and `gear_torques`.
    """
    q, qd, middle, speed = state[0], state[1], state[2], state[3]
    n, count, total = tau.size, bristles.shape[0], q.size
    full = rotor.copy()
    held = np.zeros(total)
    for i in range(n):
        held[i] = tau[i]
    gravity = np.zeros(total)
    for i in range(link.size):
        a = link[i]
        gravity[a] = bias[i]
        full[a, a] += mass[i, i]
        for j in range(i + 1, link.size):
            b = link[j]
            full[a, b] += mass[i, j]
            full[b, a] += mass[i, j]
    force, slope, matrix = np.empty(total), np.empty((total, total)), np.empty((total, total))
    gives = gears.shape[0] > 0
    stiff = np.empty((total, total) if gives else (0, 0))
    k1, k2, k3, x1, x2, x3 = (
        np.empty(total), np.empty(total), np.empty(total), np.empty(total), np.empty(total), np.empty(total)
    )  # fmt: skip
    q2, qd2, mk = np.empty(total), np.empty(total), np.empty(total)
    rows = np.empty((7, count))
    z1, z2, z3, rate, inverse, cross, pull = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]
    loaded = False
    for e in range(table.shape[0]):
        loaded |= int(table[e, 0]) == LOAD_CODE
    before = qd.copy()
    last = before.copy() if loaded else before
    h = period / substeps
    hg = h * GAMMA
    for step in range(substeps):
        now = t + (step + 0.5) * h
        friction_torques(q, qd, now, friction, smoothing, pairs, ratio, table, load, force, slope)
        if gives:
            stiff[:, :] = 0.0
            gear_torques(q, qd, gears, force, slope, stiff)
        for i in range(total):
            for j in range(total):
                matrix[i, j] = full[i, j] / hg + slope[i, j]
            k1[i] = held[i] - gravity[i] - force[i]
        if gives:
            for i in range(total):
                for j in range(total):
                    matrix[i, j] += hg * stiff[i, j]
                    k1[i] -= hg * stiff[i, j] * qd[j]
        for b in range(count):
            # The bristle's own stage is eliminated into the stage of its joint.
            j = int(bristles[b, 0])
            rate[b], own, cross[b] = bristle_rate(bristles[b], z[b], qd[j])
            inverse[b] = 1.0 / (1.0 / hg - own)
            pull[b] = (bristles[b, 5] + bristles[b, 6] * own) * inverse[b]
            matrix[j, j] += max(bristles[b, 6] * cross[b] + pull[b] * cross[b], -0.5 * full[j, j] / hg)
            k1[j] -= bristles[b, 5] * z[b] + bristles[b, 6] * rate[b] + pull[b] * rate[b]
        _factor(matrix)
        _solve(matrix, k1)
        for i in range(total):
            x1[i] = hg * (qd[i] + k1[i])
            q2[i] = q[i] + x1[i]
            qd2[i] = qd[i] + k1[i]
        friction_torques(q2, qd2, now, friction, smoothing, pairs, ratio, table, load, force, slope)
        if gives:
            gear_torques(q2, qd2, gears, force, slope, slope)
        for b in range(count):
            j = int(bristles[b, 0])
            z1[b] = inverse[b] * (rate[b] + cross[b] * k1[j])
            rate[b] = bristle_rate(bristles[b], z[b] + z1[b], qd2[j])[0]
            force[j] += bristles[b, 5] * (z[b] + z1[b]) + bristles[b, 6] * rate[b]
        for i in range(total):
            s = 0.0
            for j in range(total):
                s += full[i, j] * k1[j]
            mk[i] = s / h
            k2[i] = held[i] - gravity[i] - force[i] + C21 * mk[i]
        if gives:
            for i in range(total):
                for j in range(total):
                    k2[i] -= hg * stiff[i, j] * (qd2[j] + C21 * x1[j] / h)
        for b in range(count):
            k2[int(bristles[b, 0])] -= pull[b] * (rate[b] + C21 * z1[b] / h)
        _solve(matrix, k2)
        for b in range(count):
            z2[b] = inverse[b] * (rate[b] + C21 * z1[b] / h + cross[b] * k2[int(bristles[b, 0])])
        for i in range(total):
            s = 0.0
            for j in range(total):
                s += full[i, j] * k2[j]
            k3[i] = held[i] - gravity[i] - force[i] + C31 * mk[i] + C32 * s / h
            x2[i] = hg * (qd2[i] + k2[i] + C21 * x1[i] / h)
        if gives:
            for i in range(total):
                for j in range(total):
                    k3[i] -= hg * stiff[i, j] * (qd2[j] + (C31 * x1[j] + C32 * x2[j]) / h)
        for b in range(count):
            k3[int(bristles[b, 0])] -= pull[b] * (rate[b] + (C31 * z1[b] + C32 * z2[b]) / h)
        _solve(matrix, k3)
        for i in range(total):
            x3[i] = hg * (qd2[i] + k3[i] + (C31 * x1[i] + C32 * x2[i]) / h)
            q[i] += x1[i] + M2 * x2[i] + M3 * x3[i]
            qd[i] += k1[i] + M2 * k2[i] + M3 * k3[i]
        for b in range(count):
            z3[b] = inverse[b] * (rate[b] + (C31 * z1[b] + C32 * z2[b]) / h + cross[b] * k3[int(bristles[b, 0])])
            z[b] += z1[b] + M2 * z2[b] + M3 * z3[b]
        if loaded:
            for i in range(n):
                load[i] = bias[i]
                for j in range(link.size):
                    a = link[j]
                    load[i] += mass[min(i, j), max(i, j)] * (qd[a] - last[a]) / h
            for i in range(total):
                last[i] = qd[i]
    for i in range(total):
        half = 0.5 * (qd[i] - before[i])
        speed[i] = qd[i] + half
        middle[i] = q[i] + 0.5 * period * (qd[i] + 0.5 * half)
