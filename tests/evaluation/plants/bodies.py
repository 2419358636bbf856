"""Rigid-body dynamics of a serial chain by spatial vectors in the base frame, compiled (Featherstone 2008).

Each link is a mass, a first moment and an inertia about the origin of the base, so that composite bodies are sums. The
tests compare mass matrix and nonlinear effects with Pinocchio.
"""

import math

import numpy as np

from armident.compiled import PLAIN, compiled


@compiled(**PLAIN)
def cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    """Cross product of two vectors, as three numbers.

    ``ax``, ``ay``, ``az``, ``bx``, ``by``, ``bz``: components of the vectors.
    """
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@compiled(**PLAIN)
def place(q, mdh, prismatic, mass, com, inertia, axes, bodies):  # type: ignore[no-untyped-def]
    """Joint axes and link inertias in the base frame.

    Parameters
    ----------
    q
        Positions, rad or m, shape (n,).
    mdh
        alpha, d, theta, r by joint (modified Denavit-Hartenberg), shape (n, 4).
    prismatic
        1 for a prismatic joint, shape (n,).
    mass, com, inertia
        Masses, kg, centres of mass in the link frames, m, and inertias about them, kg m^2; (n,), (n, 3), (n, 3, 3).
    axes
        Resulting spatial axes, angular before linear, shape (n, 6).
    bodies
        Resulting inertias: mass, first moment (3), inertia about the base origin (xx, xy, xz, yy, yz, zz); (n, 10).
    """
    R = np.eye(3)
    p = np.zeros(3)
    S = np.empty((3, 3))
    T = np.empty((3, 3))
    for j in range(q.size):
        ca, sa = math.cos(mdh[j, 0]), math.sin(mdh[j, 0])
        theta, r = mdh[j, 2], mdh[j, 3]
        if prismatic[j]:
            r += q[j]
        else:
            theta += q[j]
        ct, st = math.cos(theta), math.sin(theta)
        S[0, 0], S[0, 1], S[0, 2] = ct, -st, 0.0
        S[1, 0], S[1, 1], S[1, 2] = ca * st, ca * ct, -sa
        S[2, 0], S[2, 1], S[2, 2] = sa * st, sa * ct, ca
        t0, t1, t2 = mdh[j, 1], -sa * r, ca * r
        for i in range(3):
            p[i] += R[i, 0] * t0 + R[i, 1] * t1 + R[i, 2] * t2
        for i in range(3):
            for k in range(3):
                T[i, k] = R[i, 0] * S[0, k] + R[i, 1] * S[1, k] + R[i, 2] * S[2, k]
        R[:, :] = T
        x, y, z = R[0, 2], R[1, 2], R[2, 2]
        if prismatic[j]:
            axes[j, 0] = axes[j, 1] = axes[j, 2] = 0.0
            axes[j, 3], axes[j, 4], axes[j, 5] = x, y, z
        else:
            axes[j, 0], axes[j, 1], axes[j, 2] = x, y, z
            axes[j, 3], axes[j, 4], axes[j, 5] = cross(p[0], p[1], p[2], x, y, z)
        m = mass[j]
        cx = p[0] + R[0, 0] * com[j, 0] + R[0, 1] * com[j, 1] + R[0, 2] * com[j, 2]
        cy = p[1] + R[1, 0] * com[j, 0] + R[1, 1] * com[j, 1] + R[1, 2] * com[j, 2]
        cz = p[2] + R[2, 0] * com[j, 0] + R[2, 1] * com[j, 1] + R[2, 2] * com[j, 2]
        for i in range(3):
            for k in range(3):
                S[i, k] = R[i, 0] * inertia[j, 0, k] + R[i, 1] * inertia[j, 1, k] + R[i, 2] * inertia[j, 2, k]
        for i in range(3):
            for k in range(i, 3):
                T[i, k] = S[i, 0] * R[k, 0] + S[i, 1] * R[k, 1] + S[i, 2] * R[k, 2]
        bodies[j, 0] = m
        bodies[j, 1], bodies[j, 2], bodies[j, 3] = m * cx, m * cy, m * cz
        bodies[j, 4] = T[0, 0] + m * (cy * cy + cz * cz)
        bodies[j, 5] = T[0, 1] - m * cx * cy
        bodies[j, 6] = T[0, 2] - m * cx * cz
        bodies[j, 7] = T[1, 1] + m * (cx * cx + cz * cz)
        bodies[j, 8] = T[1, 2] - m * cy * cz
        bodies[j, 9] = T[2, 2] + m * (cx * cx + cy * cy)


@compiled(**PLAIN)
def momentum(body, v, out):  # type: ignore[no-untyped-def]
    """Product of a spatial inertia and a spatial vector, angular before linear.

    ``body``: row of ``bodies`` of `place`, shape (10,); ``v``: velocity or acceleration, shape (6,); ``out``: resulting
    momentum or force, shape (6,).
    """
    m, hx, hy, hz = body[0], body[1], body[2], body[3]
    w0, w1, w2, u0, u1, u2 = v[0], v[1], v[2], v[3], v[4], v[5]
    c0, c1, c2 = cross(hx, hy, hz, u0, u1, u2)
    out[0] = body[4] * w0 + body[5] * w1 + body[6] * w2 + c0
    out[1] = body[5] * w0 + body[7] * w1 + body[8] * w2 + c1
    out[2] = body[6] * w0 + body[8] * w1 + body[9] * w2 + c2
    c0, c1, c2 = cross(hx, hy, hz, w0, w1, w2)
    out[3] = m * u0 - c0
    out[4] = m * u1 - c1
    out[5] = m * u2 - c2


@compiled(**PLAIN)
def mass_and_bias(qd, gravity, axes, bodies, M, bias):  # type: ignore[no-untyped-def]
    """Mass matrix, and torques of gravity, Coriolis and centrifugal effects.

    ``qd``: velocities, shape (n,). ``gravity``: acceleration of gravity in frame 0, m/s^2, shape (3,). ``axes``,
    ``bodies``: of `place`; ``bodies`` is replaced by the composite bodies. ``M``, ``bias``: resulting mass matrix,
    shape (n, n), and torques, shape (n,).
    """
    n = qd.size
    V = np.zeros(6)
    A = np.zeros(6)
    A[3], A[4], A[5] = -gravity[0], -gravity[1], -gravity[2]
    F = np.zeros((n, 6))
    h = np.empty(6)
    f = np.empty(6)
    for j in range(n):
        s = axes[j]
        rate = qd[j]
        # Bias acceleration: the axis moves with the link before it.
        c0, c1, c2 = cross(V[0], V[1], V[2], s[0], s[1], s[2])
        d0, d1, d2 = cross(V[0], V[1], V[2], s[3], s[4], s[5])
        e0, e1, e2 = cross(V[3], V[4], V[5], s[0], s[1], s[2])
        A[0] += rate * c0
        A[1] += rate * c1
        A[2] += rate * c2
        A[3] += rate * (d0 + e0)
        A[4] += rate * (d1 + e1)
        A[5] += rate * (d2 + e2)
        for k in range(6):
            V[k] += rate * s[k]
        momentum(bodies[j], V, h)
        momentum(bodies[j], A, f)
        c0, c1, c2 = cross(V[0], V[1], V[2], h[0], h[1], h[2])
        d0, d1, d2 = cross(V[3], V[4], V[5], h[3], h[4], h[5])
        e0, e1, e2 = cross(V[0], V[1], V[2], h[3], h[4], h[5])
        F[j, 0] = f[0] + c0 + d0
        F[j, 1] = f[1] + c1 + d1
        F[j, 2] = f[2] + c2 + d2
        F[j, 3] = f[3] + e0
        F[j, 4] = f[4] + e1
        F[j, 5] = f[5] + e2
    for j in range(n - 1, -1, -1):
        if j + 1 < n:
            F[j] += F[j + 1]
            bodies[j] += bodies[j + 1]
        s = axes[j]
        total = 0.0
        for k in range(6):
            total += s[k] * F[j, k]
        bias[j] = total
        momentum(bodies[j], s, h)
        for i in range(j + 1):
            total = 0.0
            for k in range(6):
                total += axes[i, k] * h[k]
            M[i, j] = M[j, i] = total


@compiled(kept=True, **PLAIN)
def evaluate(q, qd, gravity, mdh, prismatic, mass, com, inertia):  # type: ignore[no-untyped-def]
    """Mass matrix, shape (n, n), and bias torques, shape (n,), at one state.

    ``q``, ``qd``: positions and velocities, shape (n,); ``gravity``: acceleration of gravity in frame 0, m/s^2, shape
    (3,); ``mdh``, ``prismatic``, ``mass``, ``com``, ``inertia``: bodies, see `place`.
    """
    n = q.size
    axes, bodies = np.empty((n, 6)), np.empty((n, 10))
    M, bias = np.empty((n, n)), np.empty(n)
    place(q, mdh, prismatic, mass, com, inertia, axes, bodies)
    mass_and_bias(qd, gravity, axes, bodies, M, bias)
    return M, bias
