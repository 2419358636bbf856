"""Compiled closed loop of a random arm: rigid bodies, dry friction as impulses with bounds, controllers, encoders.

One step is linearly implicit in velocities: viscous friction, springs and contacts are stable at any stiffness. Dry
friction is a box-constrained impulse by joint (projected Gauss-Seidel): a joint sticks where the bound suffices, and
no velocity scale smooths the sign.
"""

import math

import numpy as np
from numba import njit

from armident.virtual_robot.random_arms.bodies import mass_and_bias, place
from armident.virtual_robot.random_arms.slots import (
    COULOMB,
    COULOMB_FORWARD,
    CURVE,
    CURVE_POWER,
    CURVE_VELOCITY,
    ECCENTRICITY,
    ECCENTRICITY_ORDER,
    ECCENTRICITY_PHASE,
    FEEDFORWARD,
    FILTER,
    KI,
    KP,
    KV,
    LAG,
    LIMIT,
    LOAD,
    LOAD_KNEE,
    OFFSET,
    ONE_LOOP,
    PRESLIDING,
    RIPPLE,
    RIPPLE_ORDER,
    RIPPLE_PHASE,
    SLOSH,
    SLOSH_DAMPING,
    SLOSH_FREQUENCY,
    SPRING,
    SPRING_CUBIC,
    SPRING_POSITION,
    STRIBECK,
    STRIBECK_LAW,
    STRIBECK_VELOCITY,
    TIGHT,
    TIGHT_POSITION,
    TIGHT_WIDTH,
    TIME_DROP,
    TIME_SCALE,
    VISCOUS,
    VISCOUS_FORWARD,
    WINDOW,
    WORK_DROP,
    WORK_SCALE,
)

SWEEPS = 25
"""Largest number of Gauss-Seidel sweeps over the friction impulses of a step."""
CONVERGED = 1e-9
"""Change of a friction impulse, relative to its bound, below which the sweeps end."""
ELEMENTS = np.array([[0.25, 0.3], [0.45, 1.0], [0.30, 2.0]])
"""Presliding by three Maxwell-slip elements: share of the dry friction, and breakaway relative to the nominal one."""


@njit(cache=True, error_model="numpy")
def dry_level(law, q, v, forward, faded, load):  # type: ignore[no-untyped-def]
    """Dry friction of a joint in one direction, N m or N.

    Parameters
    ----------
    law
        Row of the law table.
    q, v
        Position and velocity before the step.
    forward
        1 for the bound in positive direction.
    faded
        Factor of warming.
    load
        Torque that the gear transmits.
    """
    level = law[COULOMB] * faded
    if forward:
        level += law[COULOMB_FORWARD]
    if law[STRIBECK] != 0.0:
        ratio = abs(v) / law[STRIBECK_VELOCITY]
        level += law[STRIBECK] * (math.exp(-ratio) if law[STRIBECK_LAW] == 0.0 else 1.0 / (1.0 + ratio * ratio * ratio))
    if law[TIGHT] != 0.0:
        away = (q - law[TIGHT_POSITION]) / law[TIGHT_WIDTH]
        level += law[TIGHT] * math.exp(-0.5 * away * away)
    if law[LOAD] != 0.0:
        level += law[LOAD] * (math.sqrt(load * load + law[LOAD_KNEE] * law[LOAD_KNEE]) - law[LOAD_KNEE])
    return max(level, 0.0)


@njit(cache=True, error_model="numpy")
def smooth_torque(law, q, v):  # type: ignore[no-untyped-def]
    """Torque of the joint's springs, ripple, offset and curved friction against the motion, N m or N."""
    out = law[OFFSET]
    if law[VISCOUS_FORWARD] != 0.0 and v > 0.0:
        out += law[VISCOUS_FORWARD] * v
    if law[RIPPLE] != 0.0:
        out += law[RIPPLE] * math.sin(law[RIPPLE_ORDER] * q + law[RIPPLE_PHASE])
    if law[SPRING] != 0.0 or law[SPRING_CUBIC] != 0.0:
        x = q - law[SPRING_POSITION]
        out += law[SPRING] * x + law[SPRING_CUBIC] * x * x * x
    if law[CURVE] != 0.0:
        out += math.copysign(law[CURVE] * (abs(v) / law[CURVE_VELOCITY]) ** law[CURVE_POWER], v)
    return out


@njit(cache=True, error_model="numpy")
def invert(A, out):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric positive definite matrix by Cholesky's method; ``A`` is overwritten."""
    n = A.shape[0]
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= A[j, k] * A[j, k]
        d = math.sqrt(d)
        A[j, j] = d
        for i in range(j + 1, n):
            x = A[i, j]
            for k in range(j):
                x -= A[i, k] * A[j, k]
            A[i, j] = x / d
    for c in range(n):
        for i in range(n):
            x = 1.0 if i == c else 0.0
            if i < c:
                out[i, c] = 0.0
                continue
            for k in range(c, i):
                x -= A[i, k] * out[k, c]
            out[i, c] = x / A[i, i]
        for i in range(n - 1, -1, -1):
            x = out[i, c]
            for k in range(i + 1, n):
                x -= A[k, i] * out[k, c]
            out[i, c] = x / A[i, i]


@njit(cache=True, error_model="numpy")
def friction_impulses(v, AJ, rows, bounds, impulses):  # type: ignore[no-untyped-def]
    """Dry friction of a step by projected Gauss-Seidel.

    Parameters
    ----------
    v
        Velocities without dry friction, shape (N,); with it afterwards.
    AJ
        Velocity change per unit impulse of each row, shape (N, R).
    rows
        Coordinates of each row (the second is -1 for friction of one joint), shape (R, 2).
    bounds
        Largest impulses against positive and negative velocity, shape (R, 2).
    impulses
        Impulses, of the step before at first, shape (R,).
    """
    N, R = AJ.shape
    for r in range(R):
        impulses[r] = min(max(impulses[r], -bounds[r, 1]), bounds[r, 0])
        for i in range(N):
            v[i] -= AJ[i, r] * impulses[r]
    for _ in range(SWEEPS):
        worst = 0.0
        for r in range(R):
            a, b = rows[r, 0], rows[r, 1]
            speed, weight = v[a], AJ[a, r]
            if b >= 0:
                speed += v[b]
                weight += AJ[b, r]
            new = min(max(impulses[r] + speed / weight, -bounds[r, 1]), bounds[r, 0])
            change = new - impulses[r]
            if change != 0.0:
                impulses[r] = new
                for i in range(N):
                    v[i] -= AJ[i, r] * change
                worst = max(worst, abs(change) / (bounds[r, 0] + bounds[r, 1]))
        if worst < CONVERGED:
            break


@njit(cache=True, error_model="numpy")
def run(  # type: ignore[no-untyped-def]
    step, gravity, mdh, prismatic, mass, com, inertia, rotor, laws, gears, pairs, external, resolution, control, qr, qdr,
    position, velocity, acceleration, reading, torque,
):  # fmt: skip
    """Simulate the closed loop; the arrays of results are filled in place.

    Parameters
    ----------
    step
        Step of integration and control, s.
    gravity, mdh, prismatic, mass, com, inertia
        Bodies, see `place`.
    rotor
        Rotor inertias, joint side, shape (n,).
    laws
        Table of `LAWS`, shape (n, .).
    gears, pairs
        Tables of `GEARS` (E, 5) and `PAIRS` (C, 4).
    external
        Torques that act on the links from outside, shape (K, n).
    resolution
        Encoder steps, joint side, shape (n,).
    control
        Table of `CONTROLLERS`, shape (n, .).
    qr, qdr
        Reference positions and velocities, shape (K, n).
    position, velocity, acceleration
        True motion of the motors, joint side, shape (K, n).
    reading
        Encoder readings, shape (K, n).
    torque
        Torque that the drive reports without errors of measurement, shape (K, n).

    Returns
    -------
    int
        Number of steps; less than K if the loop diverged.
    """
    K, n = qr.shape
    E, C = gears.shape[0], pairs.shape[0]
    N, R = n + E, n + C
    axes, bodies = np.empty((n, 6)), np.empty((n, 10))
    ML, bias = np.empty((n, n)), np.empty(n)
    A, Ainv = np.empty((N, N)), np.empty((N, N))
    q, v, a = np.zeros(N), np.zeros(N), np.zeros(N)
    right, new = np.empty(N), np.empty(N)
    motor = np.arange(n)
    for e in range(E):
        motor[int(gears[e, 0])] = n + e
    for j in range(n):
        q[j] = q[motor[j]] = qr[0, j]
    rows = np.full((R, 2), -1, np.int64)
    for j in range(n):
        rows[j, 0] = motor[j]
    for c in range(C):
        rows[n + c, 0], rows[n + c, 1] = motor[int(pairs[c, 0])], motor[int(pairs[c, 1])]
    AJ, bounds, impulses = np.empty((N, R)), np.empty((R, 2)), np.zeros(R)
    middle = np.empty(n)
    tau, command, applied = np.zeros(n), np.zeros(n), np.zeros(n)
    integral, speed = np.zeros(n), np.zeros(n)
    work = np.zeros(n)
    load = np.zeros(n)
    bristle = np.zeros((n, 3))
    slosh = np.zeros((n, 2))
    first = True
    for k in range(K):
        t = k * step
        for j in range(n):
            m = motor[j]
            law = laws[j]
            position[k, j], velocity[k, j] = q[m], v[m]
            x = q[m]
            if law[ECCENTRICITY] != 0.0:
                x += law[ECCENTRICITY] * math.sin(law[ECCENTRICITY_ORDER] * x + law[ECCENTRICITY_PHASE])
            reading[k, j] = math.floor(x / resolution[j] + 0.5) * resolution[j]
        for j in range(n):
            gains = control[j]
            window = int(gains[WINDOW])
            back = max(k - window, 0)
            rate = (reading[k, j] - reading[back, j]) / ((k - back) * step) if k > back else 0.0
            speed[j] += gains[FILTER] * (rate - speed[j])
            error = qr[k, j] - reading[k, j]
            if gains[ONE_LOOP] > 0.0:
                # PID: derivative of the error
                integral[j] += gains[KI] * error * step
                out = gains[KP] * error + gains[KV] * (qdr[k, j] - speed[j]) + integral[j]
            else:
                demand = gains[KP] * error + gains[FEEDFORWARD] * qdr[k, j]
                integral[j] += gains[KI] * (demand - speed[j]) * step
                out = gains[KV] * (demand - speed[j]) + integral[j]
            command[j] = min(max(out, -gains[LIMIT]), gains[LIMIT])
            lag = laws[j, LAG]
            if lag > 0.0:
                applied[j] += (command[j] - applied[j]) * (1.0 - math.exp(-step / lag))
            else:
                applied[j] = command[j]
            # The reported torque is the mean of both sides of the sample.
            torque[k, j] = command[j] if first else 0.5 * (command[j] + tau[j])
            tau[j] = command[j]
        first = False
        for j in range(n):
            middle[j] = q[j] + 0.5 * step * v[j]
        place(middle, mdh, prismatic, mass, com, inertia, axes, bodies)
        mass_and_bias(v[:n], gravity, axes, bodies, ML, bias)
        A[:, :] = 0.0
        A[:n, :n] = ML
        for j in range(n):
            A[motor[j], motor[j]] += rotor[j]
        right[:] = A @ v
        for j in range(n):
            m = motor[j]
            law = laws[j]
            right[j] += step * (external[k, j] - bias[j])
            right[m] += step * (applied[j] - smooth_torque(law, q[m], v[m]))
            faded = 1.0
            if law[WORK_SCALE] > 0.0:
                faded -= law[WORK_DROP] * (1.0 - math.exp(-work[j] / law[WORK_SCALE]))
            if law[TIME_SCALE] > 0.0:
                faded -= law[TIME_DROP] * t / (t + law[TIME_SCALE])
            viscous = law[VISCOUS] * faded
            A[m, m] += step * viscous
            for forward in range(2):
                bounds[j, 1 - forward] = step * dry_level(law, q[m], v[m], forward, faded, load[j])
            if law[PRESLIDING] > 0.0:
                for e in range(3):
                    level = ELEMENTS[e, 0] * law[COULOMB] * faded
                    reach = ELEMENTS[e, 1] * law[PRESLIDING]
                    stiffness = level / reach
                    z = bristle[j, e] + step * v[m]
                    if abs(z) < reach:
                        right[m] -= step * (stiffness * bristle[j, e] + 0.5 * step * stiffness * v[m])
                        A[m, m] += 0.5 * step * step * stiffness
                    else:
                        right[m] -= step * math.copysign(level, z)
                bounds[j, 0] -= step * law[COULOMB] * faded
                bounds[j, 1] -= step * law[COULOMB] * faded
                bounds[j, 0], bounds[j, 1] = max(bounds[j, 0], 0.0), max(bounds[j, 1], 0.0)
            if law[SLOSH] > 0.0:
                w = 2.0 * math.pi * law[SLOSH_FREQUENCY]
                # mass on a spring, position relative to the link: its force acts on the link
                s0, s1 = slosh[j, 0], slosh[j, 1]
                pull = -w * w * s0 - 2.0 * law[SLOSH_DAMPING] * w * s1
                right[j] -= step * law[SLOSH] * pull
                slosh[j, 1] += step * (pull - a[j])
                slosh[j, 0] += step * slosh[j, 1]
            work[j] += step * abs(v[m]) * (viscous * abs(v[m]) + law[COULOMB] * faded)
        for e in range(E):
            j, m = int(gears[e, 0]), n + e
            twist, gap = q[m] - q[j], gears[e, 4]
            if abs(twist) > gap:
                x = twist - math.copysign(gap, twist)
                force = gears[e, 1] * x + gears[e, 2] * x * x * x
                stiffness = gears[e, 1] + 3.0 * gears[e, 2] * x * x
                both = step * gears[e, 3] + 0.5 * step * step * stiffness
                rate = v[m] - v[j]
                right[m] -= step * force + 0.5 * step * step * stiffness * rate
                right[j] += step * force + 0.5 * step * step * stiffness * rate
                A[m, m] += both
                A[j, j] += both
                A[m, j] -= both
                A[j, m] -= both
        for c in range(C):
            i, j = rows[n + c, 0], rows[n + c, 1]
            d = step * pairs[c, 2]
            A[i, i] += d
            A[j, j] += d
            A[i, j] += d
            A[j, i] += d
            bounds[n + c, 0] = bounds[n + c, 1] = step * pairs[c, 3]
        invert(A, Ainv)
        for i in range(N):
            total = 0.0
            for c in range(N):
                total += Ainv[i, c] * right[c]
            new[i] = total
            for r in range(R):
                AJ[i, r] = Ainv[i, rows[r, 0]]
                if rows[r, 1] >= 0:
                    AJ[i, r] += Ainv[i, rows[r, 1]]
        friction_impulses(new, AJ, rows, bounds, impulses)
        for i in range(N):
            a[i] = (new[i] - v[i]) / step
            q[i] += 0.5 * step * (v[i] + new[i])
            if not abs(q[i]) < 1e3:
                return k
        for j in range(n):
            m = motor[j]
            total = bias[j]
            for c in range(n):
                total += ML[j, c] * a[c]
            load[j] = total
            # The acceleration at a sample is the mean of both sides.
            acceleration[k, j] = a[m]
            if laws[j, PRESLIDING] > 0.0:
                move = 0.5 * step * (v[m] + new[m])
                for e in range(3):
                    reach = ELEMENTS[e, 1] * laws[j, PRESLIDING]
                    bristle[j, e] = min(max(bristle[j, e] + move, -reach), reach)
        v[:] = new
    for k in range(K - 1, 0, -1):
        for j in range(n):
            acceleration[k, j] = 0.5 * (acceleration[k, j] + acceleration[k - 1, j])
    return K
