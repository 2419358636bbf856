"""Compiled closed loop of a random arm: rigid bodies, dry friction as bounded impulses, controllers, encoders.

One step is linearly implicit in velocities: viscous friction, springs and contacts are stable at any stiffness. Dry
friction is a bounded impulse by joint (projected Gauss-Seidel). With a sharp sign a joint sticks where the bound
suffices; with a smooth one (``tanh`` of the velocity) the impulse is that of the velocity after the step.
"""

import math

import numpy as np

from armident.compiled import PLAIN, compiled
from tests.evaluation.plants.bodies import mass_and_bias, place
from tests.evaluation.plants.friction import dry_level, friction_impulses, smooth_torque, warmed
from tests.evaluation.plants.loops import command, read_encoder
from tests.evaluation.plants.slots import (
    COULOMB,
    LAG,
    PRESLIDING,
    SLOSH,
    SLOSH_DAMPING,
    SLOSH_FREQUENCY,
    SMOOTHING,
    VISCOUS,
)

ELEMENTS = np.array([[0.25, 0.3], [0.45, 1.0], [0.30, 2.0]])
"""Presliding by three Maxwell-slip elements: share of the dry friction, and breakaway relative to the nominal one."""
FARTHEST = 1e3
"""Position, rad or m, beyond which a loop counts as diverged."""


@compiled(**PLAIN)
def invert(A, out):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric positive definite matrix by Cholesky's method.

    ``A``: the matrix, shape (N, N); overwritten. ``out``: resulting inverse, shape (N, N).
    """
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


@compiled(**PLAIN)
def presliding(law, level, step, speed, bristle):  # type: ignore[no-untyped-def]
    """Impulse of the bristles of a joint, and the stiffness of those that stick times half a squared step.

    ``law``: row of the law table; ``level``: dry friction that the bristles carry together; ``speed``: velocity before
    the step; ``bristle``: deflections, shape (3,).
    """
    impulse, stiff = 0.0, 0.0
    for e in range(3):
        share = ELEMENTS[e, 0] * level
        reach = ELEMENTS[e, 1] * law[PRESLIDING]
        z = bristle[e] + step * speed
        if abs(z) < reach:
            half = 0.5 * step * step * share / reach
            impulse += step * share / reach * bristle[e] + half * speed
            stiff += half
        else:
            impulse += step * math.copysign(share, z)
    return impulse, stiff


@compiled(**PLAIN)
def move_bristles(law, move, bristle):  # type: ignore[no-untyped-def]
    """Move the bristles of a joint by a distance; each slides beyond its reach.

    ``law``: row of the law table. ``move``: distance, rad or m. ``bristle``: deflections, shape (3,); written in place.
    """
    for e in range(3):
        reach = ELEMENTS[e, 1] * law[PRESLIDING]
        bristle[e] = min(max(bristle[e] + move, -reach), reach)


@compiled(**PLAIN)
def slosh_impulse(law, step, acceleration, slosh):  # type: ignore[no-untyped-def]
    """Impulse of a mass on a spring on the link, and its motion.

    ``law``: row of the law table. ``acceleration``: acceleration of the link in the step before. ``slosh``: position
    and velocity relative to the link, shape (2,); written in place.
    """
    w = 2.0 * math.pi * law[SLOSH_FREQUENCY]
    pull = -w * w * slosh[0] - 2.0 * law[SLOSH_DAMPING] * w * slosh[1]
    slosh[1] += step * (pull - acceleration)
    slosh[0] += step * slosh[1]
    return -step * law[SLOSH] * pull


@compiled(**PLAIN)
def add_gears(gears, motor, step, q, v, A, right):  # type: ignore[no-untyped-def]
    """Add the torques of flexible gears and of contacts with play.

    ``gears``: table of `GEARS`, shape (E, 5). ``motor``: coordinate of each motor, shape (n,). ``q``, ``v``:
    coordinates and velocities before the step, shape (N,). ``A``, ``right``: matrix (N, N) and right-hand side (N,) of
    the step; written in place.
    """
    for e in range(gears.shape[0]):
        j = int(gears[e, 0])
        m = motor[j]
        twist, gap = q[m] - q[j], gears[e, 4]
        if abs(twist) <= gap:
            continue
        x = twist - math.copysign(gap, twist)
        force = gears[e, 1] * x + gears[e, 2] * x * x * x
        half = 0.5 * step * step * (gears[e, 1] + 3.0 * gears[e, 2] * x * x)
        both = step * gears[e, 3] + half
        impulse = step * force + half * (v[m] - v[j])
        right[m] -= impulse
        right[j] += impulse
        A[m, m] += both
        A[j, j] += both
        A[m, j] -= both
        A[j, m] -= both


@compiled(**PLAIN)
def solve_step(A, right, rows, bounds, smoothing, impulses, new):  # type: ignore[no-untyped-def]
    """Velocities after a step.

    ``A``, ``right``: matrix (N, N) and right-hand side (N,) without dry friction; ``A`` is overwritten. ``rows``,
    ``bounds``, ``smoothing``, ``impulses``: dry friction, see `friction_impulses`. ``new``: resulting velocities, shape
    (N,).
    """
    N, R = right.size, rows.shape[0]
    inverse, AJ = np.empty((N, N)), np.empty((N, R))
    invert(A, inverse)
    for i in range(N):
        total = 0.0
        for c in range(N):
            total += inverse[i, c] * right[c]
        new[i] = total
        for r in range(R):
            AJ[i, r] = inverse[i, rows[r, 0]]
            if rows[r, 1] >= 0:
                AJ[i, r] += inverse[i, rows[r, 1]]
    friction_impulses(new, AJ, rows, bounds, smoothing, impulses)


@compiled(**PLAIN)
def friction_rows(motor, pairs):  # type: ignore[no-untyped-def]
    """Coordinates of each row of dry friction, shape (R, 2): the motors, then the pairs.

    ``motor``: coordinate of each motor, shape (n,); ``pairs``: table of `PAIRS`, shape (C, 4).
    """
    n, C = motor.size, pairs.shape[0]
    rows = np.full((n + C, 2), -1, np.int64)
    rows[:n, 0] = motor
    for c in range(C):
        rows[n + c, 0], rows[n + c, 1] = motor[int(pairs[c, 0])], motor[int(pairs[c, 1])]
    return rows


@compiled(kept=True, **PLAIN)
def run(  # type: ignore[no-untyped-def]
    step, gravity, mdh, prismatic, mass, com, inertia, rotor, laws, gears, pairs, external, resolution, control, qr,
    qdr, position, velocity, acceleration, reading, torque,
):  # fmt: skip
    """Simulate the closed loop; the arrays of results are filled in place.

    Returns the number of steps; less than K if the loop diverged.

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
    """
    K, n = qr.shape
    N = n + gears.shape[0]
    axes, bodies, ML, bias = np.empty((n, 6)), np.empty((n, 10)), np.empty((n, n)), np.empty(n)
    A, right, new = np.empty((N, N)), np.empty(N), np.empty(N)
    q, v, a = np.zeros(N), np.zeros(N), np.zeros(N)
    motor = np.arange(n)
    for e in range(gears.shape[0]):
        motor[int(gears[e, 0])] = n + e
    q[:n] = qr[0]
    q[motor] = qr[0]
    rows = friction_rows(motor, pairs)
    bounds, impulses, smoothing = np.empty((rows.shape[0], 2)), np.zeros(rows.shape[0]), np.zeros(rows.shape[0])
    smoothing[:n] = laws[:, SMOOTHING]
    tau, applied, integral, speed, work, load = np.zeros((6, n))
    bristle, slosh = np.zeros((n, 3)), np.zeros((n, 2))
    for k in range(K):
        for j in range(n):
            m = motor[j]
            position[k, j], velocity[k, j] = q[m], v[m]
            reading[k, j] = read_encoder(laws[j], q[m], resolution[j])
            demand = command(control[j], k, j, step, reading, qr, qdr, speed, integral)
            lag = laws[j, LAG]
            applied[j] += (demand - applied[j]) * (1.0 - math.exp(-step / lag) if lag > 0.0 else 1.0)
            # The reported torque is the mean of both sides of the sample.
            torque[k, j] = 0.5 * (demand + tau[j]) if k else demand
            tau[j] = demand
        place(q[:n] + 0.5 * step * v[:n], mdh, prismatic, mass, com, inertia, axes, bodies)
        mass_and_bias(v[:n], gravity, axes, bodies, ML, bias)
        A[:, :] = 0.0
        A[:n, :n] = ML
        for j in range(n):
            A[motor[j], motor[j]] += rotor[j]
        right[:] = A @ v
        for j in range(n):
            m, law = motor[j], laws[j]
            right[j] += step * (external[k, j] - bias[j])
            right[m] += step * (applied[j] - smooth_torque(law, q[m], v[m]))
            faded = warmed(law, k * step, work[j])
            dry, viscous = law[COULOMB] * faded, law[VISCOUS] * faded
            A[m, m] += step * viscous
            bounds[j, 0] = step * dry_level(law, q[m], v[m], True, faded, load[j])
            bounds[j, 1] = step * dry_level(law, q[m], v[m], False, faded, load[j])
            if law[PRESLIDING] > 0.0:
                impulse, stiff = presliding(law, dry, step, v[m], bristle[j])
                right[m] -= impulse
                A[m, m] += stiff
                # The bristles replace the dry friction of the joint.
                bounds[j, 0], bounds[j, 1] = max(bounds[j, 0] - step * dry, 0.0), max(bounds[j, 1] - step * dry, 0.0)
            if law[SLOSH] > 0.0:
                right[j] += slosh_impulse(law, step, a[j], slosh[j])
            work[j] += step * abs(v[m]) * (viscous * abs(v[m]) + dry)
        add_gears(gears, motor, step, q, v, A, right)
        for c in range(n, rows.shape[0]):
            i, j = rows[c]
            d = step * pairs[c - n, 2]
            A[i, i] += d
            A[j, j] += d
            A[i, j] += d
            A[j, i] += d
            bounds[c, 0] = bounds[c, 1] = step * pairs[c - n, 3]
        solve_step(A, right, rows, bounds, smoothing, impulses, new)
        a[:] = (new - v) / step
        q += 0.5 * step * (v + new)
        if not np.abs(q).max() < FARTHEST:
            return k
        load[:] = bias + ML @ a[:n]
        for j in range(n):
            m = motor[j]
            acceleration[k, j] = a[m]
            if laws[j, PRESLIDING] > 0.0:
                move_bristles(laws[j], 0.5 * step * (v[m] + new[m]), bristle[j])
        v[:] = new
    # The acceleration at a sample is the mean of both sides.
    acceleration[1:] = 0.5 * (acceleration[1:] + acceleration[:-1])
    return K
