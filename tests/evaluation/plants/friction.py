"""Compiled laws of friction, springs and ripple, and the impulses of dry friction."""

import math

from armident.compiled import PLAIN, compiled
from tests.evaluation.plants.slots import (
    COULOMB,
    COULOMB_FORWARD,
    CURVE,
    CURVE_POWER,
    CURVE_VELOCITY,
    LOAD,
    LOAD_KNEE,
    OFFSET,
    RIPPLE,
    RIPPLE_ORDER,
    RIPPLE_PHASE,
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
    VISCOUS_FORWARD,
    WORK_DROP,
    WORK_SCALE,
)

SWEEPS = 25
"""Largest number of Gauss-Seidel sweeps over the friction impulses of a step."""
NEWTON = 6
"""Largest number of Newton steps for the impulse of a smooth sign."""
CONVERGED = 1e-9
"""Change of a friction impulse, relative to its bound, below which the sweeps end."""
COLDEST = 0.02
"""Smallest factor of friction that warming leaves."""


@compiled(**PLAIN)
def warmed(law, t, work):  # type: ignore[no-untyped-def]
    """Factor of friction after a time and an amount of dissipated work.

    ``law``: row of the law table; ``work``: work dissipated at the joint, J.
    """
    out = 1.0
    if law[WORK_SCALE] > 0.0:
        out -= law[WORK_DROP] * (1.0 - math.exp(-work / law[WORK_SCALE]))
    if law[TIME_SCALE] > 0.0:
        out -= law[TIME_DROP] * t / (t + law[TIME_SCALE])
    return max(out, COLDEST)


@compiled(**PLAIN)
def dry_level(law, q, v, forward, faded, load):  # type: ignore[no-untyped-def]
    """Dry friction of a joint in one direction, N m or N.

    ``law``: row of the law table; ``q``, ``v``: position and velocity before the step; ``forward``: 1 for the bound in
    positive direction; ``faded``: factor of warming; ``load``: torque that the gear transmits.
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


@compiled(**PLAIN)
def smooth_torque(law, q, v):  # type: ignore[no-untyped-def]
    """Torque of the joint's springs, ripple, offset and curved friction against the motion, N m or N.

    ``law``: row of the law table; ``q``, ``v``: position and velocity before the step.
    """
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


@compiled(**PLAIN)
def one_impulse(speed, weight, forward, backward, smoothing):  # type: ignore[no-untyped-def]
    """Impulse of one row of dry friction: bounded, or bounded times ``tanh`` of the velocity after the step.

    With a smooth sign the equation is monotone and, from the start value of the piecewise linear sign, convex: Newton's
    method approaches the solution from one side.

    ``speed``: velocity without this impulse. ``weight``: velocity change per unit impulse. ``forward``, ``backward``:
    largest impulses against positive and negative velocity. ``smoothing``: velocity scale of the smooth sign; 0 for a
    sharp one, which sticks.
    """
    if smoothing <= 0.0:
        return min(max(speed / weight, -backward), forward)
    level = forward if speed > 0.0 else backward
    if level <= 0.0:
        return 0.0
    out = min(max(speed / (weight + smoothing / level), -level), level)
    for _ in range(NEWTON):
        sign = math.tanh((speed - weight * out) / smoothing)
        change = (out - level * sign) / (1.0 + level * weight / smoothing * (1.0 - sign * sign))
        out -= change
        if abs(change) < CONVERGED * level:
            break
    return out


@compiled(**PLAIN)
def friction_impulses(v, AJ, rows, bounds, smoothing, impulses):  # type: ignore[no-untyped-def]
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
    smoothing
        Velocity scale of the smooth sign of each row; 0 for a sharp one, shape (R,).
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
            speed += weight * impulses[r]
            new = one_impulse(speed, weight, bounds[r, 0], bounds[r, 1], smoothing[r])
            change = new - impulses[r]
            if change != 0.0:
                impulses[r] = new
                for i in range(N):
                    v[i] -= AJ[i, r] * change
                worst = max(worst, abs(change) / (bounds[r, 0] + bounds[r, 1]))
        if worst < CONVERGED:
            break
