"""Compiled recursions over the chain: regressor, inverse dynamics, mass matrix and bias forces.

Newton-Euler recursion in modified Denavit-Hartenberg frames (A.22 to A.26); gravity is the acceleration ``-g`` of the
base. Vectors of link j are in frame j, one scalar variable a component. Sizes: N samples, n joints.
"""

import numpy as np

from armident.arrays import Array
from armident.compiled import ARITHMETIC, compiled, inlined
from armident.identify.robot.chain import Chain, Columns, Values
from armident.identify.robot.elementary import padded, sines_cosines

TWO_OVER_PI = 2.0 / np.pi


@inlined
def smooth_sign(x: float, smoothing: float) -> float:
    """``sign(x)``, or ``(2/pi) atan(smoothing x)`` if ``smoothing`` is positive (thesis section B.2)."""
    return TWO_OVER_PI * np.arctan(smoothing * x) if smoothing > 0.0 else float(np.sign(x))


@inlined
def into_child(ca: float, sa: float, c: float, s: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rotate a vector from frame j-1 to frame j; cosines and sines of the twist alpha_j and of theta_j."""
    t = ca * y + sa * z
    return c * x + s * t, c * t - s * x, ca * z - sa * y


@inlined
def into_parent(ca: float, sa: float, c: float, s: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rotate a vector from frame j to frame j-1; cosines and sines of the twist alpha_j and of theta_j."""
    t = s * x + c * y
    return c * x - s * y, ca * t - sa * z, sa * t + ca * z


@inlined
def turn(n: int, chain: Chain, q: Array, angle: Array, sine: Array, cosine: Array) -> None:
    """Compute joint angles, rad, sines and cosines of one sample (n,) into arrays of `padded` length."""
    for j in range(n):
        angle[j] = chain.theta[j] + (0.0 if chain.prismatic[j] else q[j])
    sines_cosines(angle, sine, cosine)


@compiled("Chain, Columns, f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1]", **ARITHMETIC)
def fill_regressor(
    chain: Chain, columns: Columns, smoothing: Array, q: Array, qd: Array, qdd: Array, out: Array
) -> None:
    """Compute the regressor of the inverse dynamic model (thesis equation 2.8); column -1: left out.

    ``out`` (N, n, columns) holds zeros, or an earlier result of the same ``columns``. ``smoothing`` 0: the sharp sign.
    """
    n = chain.d.size
    lin = np.empty((n, 3))
    ang = np.empty((n, 3))
    angle, sine, cosine = np.zeros(padded(n)), np.empty(padded(n)), np.empty(padded(n))
    for k in range(q.shape[0]):
        turn(n, chain, q[k], angle, sine, cosine)
        wx = wy = wz = bx = by = bz = 0.0
        ax, ay, az = -chain.gravity[0], -chain.gravity[1], -chain.gravity[2]
        for j in range(n):
            v, a = qd[k, j], qdd[k, j]
            ca, sa, d = chain.cos_alpha[j], chain.sin_alpha[j], chain.d[j]
            moves = chain.prismatic[j]
            r = chain.r[j] + (q[k, j] if moves else 0.0)
            c, s = cosine[j], sine[j]
            px, py, pz = d, -r * sa, r * ca
            # Acceleration of O_j before the joint's own motion: a + wd x P + w x (w x P).
            ux, uy, uz = wy * pz - wz * py, wz * px - wx * pz, wx * py - wy * px
            ax += by * pz - bz * py + wy * uz - wz * uy
            ay += bz * px - bx * pz + wz * ux - wx * uz
            az += bx * py - by * px + wx * uy - wy * ux
            ax, ay, az = into_child(ca, sa, c, s, ax, ay, az)
            wx, wy, wz = into_child(ca, sa, c, s, wx, wy, wz)
            bx, by, bz = into_child(ca, sa, c, s, bx, by, bz)
            if moves:
                ax += 2.0 * v * wy
                ay -= 2.0 * v * wx
                az += a
            else:
                bx += wy * v
                by -= wx * v
                bz += a
                wz += v
            for i in range(j):
                lx, ly, lz = lin[i, 0], lin[i, 1], lin[i, 2]
                rx, ry, rz = ang[i, 0], ang[i, 1], ang[i, 2]
                lin[i, 0], lin[i, 1], lin[i, 2] = into_child(
                    ca, sa, c, s, lx + ry * pz - rz * py, ly + rz * px - rx * pz, lz + rx * py - ry * px
                )
                ang[i, 0], ang[i, 1], ang[i, 2] = into_child(ca, sa, c, s, rx, ry, rz)
            lin[j, 0] = lin[j, 1] = ang[j, 0] = ang[j, 1] = 0.0
            lin[j, 2] = 1.0 if moves else 0.0
            ang[j, 2] = 0.0 if moves else 1.0

            axx, ayy, azz = -(wy * wy + wz * wz), -(wx * wx + wz * wz), -(wx * wx + wy * wy)
            axy, ayx = wx * wy - bz, wx * wy + bz
            axz, azx = wx * wz + by, wx * wz - by
            ayz, azy = wy * wz - bx, wy * wz + bx
            col = columns.inertial[j]
            for i in range(j + 1):
                lx, ly, lz = lin[i, 0], lin[i, 1], lin[i, 2]
                rx, ry, rz = ang[i, 0], ang[i, 1], ang[i, 2]
                ux, uy, uz = ry * wz - rz * wy, rz * wx - rx * wz, rx * wy - ry * wx
                row = out[k, i]
                if col[0] >= 0:
                    row[col[0]] = rx * bx + ux * wx
                if col[1] >= 0:
                    row[col[1]] = rx * by + ry * bx + ux * wy + uy * wx
                if col[2] >= 0:
                    row[col[2]] = rx * bz + rz * bx + ux * wz + uz * wx
                if col[3] >= 0:
                    row[col[3]] = ry * by + uy * wy
                if col[4] >= 0:
                    row[col[4]] = ry * bz + rz * by + uy * wz + uz * wy
                if col[5] >= 0:
                    row[col[5]] = rz * bz + uz * wz
                if col[6] >= 0:
                    row[col[6]] = lx * axx + ly * ayx + lz * azx - ry * az + rz * ay
                if col[7] >= 0:
                    row[col[7]] = lx * axy + ly * ayy + lz * azy + rx * az - rz * ax
                if col[8] >= 0:
                    row[col[8]] = lx * axz + ly * ayz + lz * azz - rx * ay + ry * ax
                if col[9] >= 0:
                    row[col[9]] = lx * ax + ly * ay + lz * az
            row = out[k, j]
            if columns.ia[j] >= 0:
                row[columns.ia[j]] = a
            if columns.fv[j] >= 0:
                row[columns.fv[j]] = v
            if columns.fc[j] >= 0:
                row[columns.fc[j]] = smooth_sign(v, smoothing[j])
            if columns.off[j] >= 0:
                row[columns.off[j]] = 1.0
        for m in range(columns.coupling_joints.shape[0]):
            i, j = columns.coupling_joints[m]
            inertia, viscous, coulomb = columns.coupling[m]
            if inertia >= 0:
                out[k, i, inertia] = qdd[k, j]
                out[k, j, inertia] = qdd[k, i]
            if viscous >= 0:
                out[k, i, viscous] = qd[k, j]
                out[k, j, viscous] = qd[k, i]
            if coulomb >= 0:
                g = min(smoothing[i], smoothing[j])
                out[k, i, coulomb] = out[k, j, coulomb] = smooth_sign(qd[k, i] + qd[k, j], g)


@inlined
def add_friction(values: Values, smoothing: Array, qd: Array, tau: Array) -> None:
    """Add friction, offsets and coupled friction of one sample to ``tau`` in place (thesis equations 2.7, B.1)."""
    for j in range(qd.size):
        tau[j] += values.fv[j] * qd[j] + values.off[j]
        if values.fc[j] != 0.0:
            tau[j] += values.fc[j] * smooth_sign(qd[j], smoothing[j])
    for m in range(values.coupling_joints.shape[0]):
        i, j = values.coupling_joints[m]
        sign = values.coupling[m, 2] * smooth_sign(qd[i] + qd[j], min(smoothing[i], smoothing[j]))
        tau[i] += values.coupling[m, 1] * qd[j] + sign
        tau[j] += values.coupling[m, 1] * qd[i] + sign


@inlined
def rigid_torque(
    n: int,
    chain: Chain,
    values: Values,
    q: Array,
    qd: Array,
    qdd: Array,
    sine: Array,
    cosine: Array,
    work: Array,
    tau: Array,
) -> None:
    """Compute the torques of the rigid chain, without friction and rotors, for one sample (A.22 to A.26).

    ``sine``, ``cosine``: of `padded` length, from `turn`. ``work`` (n, 6): scratch of each link's force and moment.
    """
    wx = wy = wz = bx = by = bz = 0.0
    ax, ay, az = -chain.gravity[0], -chain.gravity[1], -chain.gravity[2]
    for j in range(n):
        v, a = qd[j], qdd[j]
        ca, sa, d = chain.cos_alpha[j], chain.sin_alpha[j], chain.d[j]
        moves = chain.prismatic[j]
        r = chain.r[j] + (q[j] if moves else 0.0)
        c, s = cosine[j], sine[j]
        # If the origins of both frames coincide, as in shoulders and wrists, the shift is zero.
        if d != 0.0 or r != 0.0:
            px, py, pz = d, -r * sa, r * ca
            ux, uy, uz = wy * pz - wz * py, wz * px - wx * pz, wx * py - wy * px
            ax += by * pz - bz * py + wy * uz - wz * uy
            ay += bz * px - bx * pz + wz * ux - wx * uz
            az += bx * py - by * px + wx * uy - wy * ux
        ax, ay, az = into_child(ca, sa, c, s, ax, ay, az)
        wx, wy, wz = into_child(ca, sa, c, s, wx, wy, wz)
        bx, by, bz = into_child(ca, sa, c, s, bx, by, bz)
        if moves:
            ax += 2.0 * v * wy
            ay -= 2.0 * v * wx
            az += a
        else:
            bx += wy * v
            by -= wx * v
            bz += a
            wz += v
        xx, xy, xz, yy, yz, zz, mx, my, mz, mass = values.inertial[j]
        ux, uy, uz = wy * mz - wz * my, wz * mx - wx * mz, wx * my - wy * mx
        work[j, 0] = mass * ax + by * mz - bz * my + wy * uz - wz * uy
        work[j, 1] = mass * ay + bz * mx - bx * mz + wz * ux - wx * uz
        work[j, 2] = mass * az + bx * my - by * mx + wx * uy - wy * ux
        ux = xx * wx + xy * wy + xz * wz
        uy = xy * wx + yy * wy + yz * wz
        uz = xz * wx + yz * wy + zz * wz
        work[j, 3] = xx * bx + xy * by + xz * bz + wy * uz - wz * uy + my * az - mz * ay
        work[j, 4] = xy * bx + yy * by + yz * bz + wz * ux - wx * uz + mz * ax - mx * az
        work[j, 5] = xz * bx + yz * by + zz * bz + wx * uy - wy * ux + mx * ay - my * ax
    fx = fy = fz = mx = my = mz = 0.0
    for j in range(n - 1, -1, -1):
        fx += work[j, 0]
        fy += work[j, 1]
        fz += work[j, 2]
        mx += work[j, 3]
        my += work[j, 4]
        mz += work[j, 5]
        moves = chain.prismatic[j]
        tau[j] = fz if moves else mz
        ca, sa, c, s = chain.cos_alpha[j], chain.sin_alpha[j], cosine[j], sine[j]
        r = chain.r[j] + (q[j] if moves else 0.0)
        d = chain.d[j]
        fx, fy, fz = into_parent(ca, sa, c, s, fx, fy, fz)
        mx, my, mz = into_parent(ca, sa, c, s, mx, my, mz)
        if d != 0.0 or r != 0.0:
            px, py, pz = d, -r * sa, r * ca
            mx += py * fz - pz * fy
            my += pz * fx - px * fz
            mz += px * fy - py * fx


@inlined
def fill_mass_matrix(n: int, chain: Chain, values: Values, q: Array, sine: Array, cosine: Array, mass: Array) -> None:
    """Compute the mass matrix of one posture, with rotors and couplings, by the composite rigid body method."""
    xx = xy = xz = yy = yz = zz = hx = hy = hz = m = 0.0
    for j in range(n - 1, -1, -1):
        p = values.inertial[j]
        xx += p[0]
        xy += p[1]
        xz += p[2]
        yy += p[3]
        yz += p[4]
        zz += p[5]
        hx += p[6]
        hy += p[7]
        hz += p[8]
        m += p[9]
        # Wrench at O_j for a unit acceleration of joint j, then transmitted towards the base.
        if chain.prismatic[j]:
            fx, fy, fz, tx, ty, tz = 0.0, 0.0, m, hy, -hx, 0.0
            mass[j, j] = m + values.ia[j]
        else:
            fx, fy, fz, tx, ty, tz = -hy, hx, 0.0, xz, yz, zz
            mass[j, j] = zz + values.ia[j]
        for i in range(j, 0, -1):
            ca, sa, c, s = chain.cos_alpha[i], chain.sin_alpha[i], cosine[i], sine[i]
            r = chain.r[i] + (q[i] if chain.prismatic[i] else 0.0)
            d = chain.d[i]
            fx, fy, fz = into_parent(ca, sa, c, s, fx, fy, fz)
            tx, ty, tz = into_parent(ca, sa, c, s, tx, ty, tz)
            if d != 0.0 or r != 0.0:
                px, py, pz = d, -r * sa, r * ca
                tx += py * fz - pz * fy
                ty += pz * fx - px * fz
                tz += px * fy - py * fx
            mass[i - 1, j] = mass[j, i - 1] = fz if chain.prismatic[i - 1] else tz
        if j == 0:
            break
        ca, sa, c, s = chain.cos_alpha[j], chain.sin_alpha[j], cosine[j], sine[j]
        r = chain.r[j] + (q[j] if chain.prismatic[j] else 0.0)
        hx, hy, hz = into_parent(ca, sa, c, s, hx, hy, hz)
        # Rotate the inertia about z, then about x; then shift it from O_j to O_j-1.
        cc, ss, cs = c * c, s * s, c * s
        jxx, jyy, jxy = (
            cc * xx - 2 * cs * xy + ss * yy,
            ss * xx + 2 * cs * xy + cc * yy,
            cs * (xx - yy) + (cc - ss) * xy,
        )
        jxz, jyz = c * xz - s * yz, s * xz + c * yz
        cc, ss, cs = ca * ca, sa * sa, ca * sa
        xx, xy, xz = jxx, ca * jxy - sa * jxz, sa * jxy + ca * jxz
        yy, yz, zz = (
            cc * jyy - 2 * cs * jyz + ss * zz,
            cs * (jyy - zz) + (cc - ss) * jyz,
            ss * jyy + 2 * cs * jyz + cc * zz,
        )
        d = chain.d[j]
        if d != 0.0 or r != 0.0:
            px, py, pz = d, -r * sa, r * ca
            gx, gy, gz = px * m + 2 * hx, py * m + 2 * hy, pz * m + 2 * hz
            square = px * gx + py * gy + pz * gz
            xx += square - px * gx
            yy += square - py * gy
            zz += square - pz * gz
            xy -= px * hy + py * hx + m * px * py
            xz -= px * hz + pz * hx + m * px * pz
            yz -= py * hz + pz * hy + m * py * pz
            hx += m * px
            hy += m * py
            hz += m * pz
    for k in range(values.coupling_joints.shape[0]):
        i, j = values.coupling_joints[k]
        mass[i, j] += values.coupling[k, 0]
        mass[j, i] += values.coupling[k, 0]


@compiled("Chain, Values, f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]", **ARITHMETIC)
def fill_inverse_dynamics(
    chain: Chain, values: Values, smoothing: Array, q: Array, qd: Array, qdd: Array, out: Array
) -> None:
    """Compute the joint torques along a motion (N, n), with friction, rotors and couplings."""
    n = chain.d.size
    work = np.empty((n, 6))
    angle, sine, cosine = np.zeros(padded(n)), np.empty(padded(n)), np.empty(padded(n))
    for k in range(q.shape[0]):
        turn(n, chain, q[k], angle, sine, cosine)
        rigid_torque(n, chain, values, q[k], qd[k], qdd[k], sine, cosine, work, out[k])
        add_friction(values, smoothing, qd[k], out[k])
        for j in range(n):
            out[k, j] += values.ia[j] * qdd[k, j]
        for m in range(values.coupling_joints.shape[0]):
            i, j = values.coupling_joints[m]
            out[k, i] += values.coupling[m, 0] * qdd[k, j]
            out[k, j] += values.coupling[m, 0] * qdd[k, i]


@compiled("Chain, Values, f8[:, ::1], f8[:, :, ::1]", **ARITHMETIC)
def fill_mass_matrices(chain: Chain, values: Values, q: Array, out: Array) -> None:
    """Compute the mass matrices (N, n, n) of several postures; see `fill_mass_matrix`."""
    n = chain.d.size
    angle, sine, cosine = np.zeros(padded(n)), np.empty(padded(n)), np.empty(padded(n))
    for k in range(q.shape[0]):
        turn(n, chain, q[k], angle, sine, cosine)
        fill_mass_matrix(n, chain, values, q[k], sine, cosine, out[k])


@inlined
def cholesky(matrix: Array, factor: Array, n: int) -> bool:
    """Factor a symmetric matrix, of which only the lower triangle is read, as ``L D L'``.

    ``factor`` (n, n): L below the diagonal, the inverse of D on it, ``D L'`` above. ``False``: not positive definite.
    """
    for j in range(n):
        pivot = matrix[j, j]
        floor = 1e-12 * abs(pivot)
        for k in range(j):
            pivot -= factor[j, k] * factor[k, j]
        if not pivot > floor:
            return False
        inverse = 1.0 / pivot
        factor[j, j] = inverse
        for i in range(j + 1, n):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[k, j]
            factor[j, i] = value
            factor[i, j] = value * inverse
    return True


@inlined
def solve_factored(factor: Array, n: int, x: Array) -> None:
    """Solve ``L D L' x = b`` in place with the factors of `cholesky`."""
    for i in range(n):
        value = x[i]
        for k in range(i):
            value -= factor[i, k] * x[k]
        x[i] = value
    for i in range(n - 1, -1, -1):
        value = x[i] * factor[i, i]
        for k in range(i + 1, n):
            value -= factor[k, i] * x[k]
        x[i] = value


@compiled("Chain, Values, f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]", **ARITHMETIC)
def fill_forward_dynamics(
    chain: Chain, values: Values, smoothing: Array, q: Array, qd: Array, tau: Array, out: Array
) -> int:
    """Compute joint accelerations (2.9); return the first sample whose mass matrix is not positive definite, or -1."""
    n = chain.d.size
    work = np.empty((n, 6))
    angle, sine, cosine = np.zeros(padded(n)), np.empty(padded(n)), np.empty(padded(n))
    mass, factor = np.empty((n, n)), np.empty((n, n))
    bias = np.empty(n)
    still = np.zeros(n)
    for k in range(q.shape[0]):
        turn(n, chain, q[k], angle, sine, cosine)
        rigid_torque(n, chain, values, q[k], qd[k], still, sine, cosine, work, bias)
        add_friction(values, smoothing, qd[k], bias)
        fill_mass_matrix(n, chain, values, q[k], sine, cosine, mass)
        if not cholesky(mass, factor, n):
            return k
        for j in range(n):
            out[k, j] = tau[k, j] - bias[j]
        solve_factored(factor, n, out[k])
    return -1
