"""Closed-loop simulation of the auxiliary model: direct dynamics under a discrete controller.

At the sampling rate the friction of a small wrist joint is too stiff for the thesis's explicit method (ode3): it is
linearly implicit here. Mass matrix and bias are extrapolated to the middle of each period from the last two samples
(second order). ``M qd' = tau - bias - friction(qd)`` is integrated by the L-stable two-stage Rosenbrock method of order
two (Shampine and Reichelt 1997, ``ode23s``), in smaller steps where a joint passes standstill.
"""

from collections.abc import Sized
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array, Ints
from armident.compiled import ARITHMETIC, compiled, inlined
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Chain, Values
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.elementary import arctangents, padded
from armident.identify.robot.kernels import TWO_OVER_PI, cholesky, fill_mass_matrix, rigid_torque, solve_factored, turn

GAMMA = 1.0 / (2.0 + np.sqrt(2.0))
"""Rosenbrock parameter that makes the two-stage method of order two L-stable."""

RUNAWAY = 10.0
"""Multiple of the configured velocity limit above which a simulation counts as diverged by default. Unstable loops grow
exponentially: twice the value ends them a few samples later."""


NEAR_STANDSTILL = 4.0
"""``g |qd|`` up to which the slope of the smoothed sign counts: it is ``1 / 17`` of that at rest there."""

STEPS_PER_UNIT = 4.0
"""Integration steps per unit change of ``g qd`` within one sample near standstill. One step gives the same accuracy as
4 and 8 at 1 to 5 kHz, half a step not; the margin is for joints that reverse faster."""

MOST_STEPS = 16
"""Maximum number of integration steps within one sample. At reversals at 1 to 5 kHz the velocity errs by 3 to 5 times
as much with 8, and by at most a quarter less with 32."""

HISTORY = 1024
"""Number of samples after which the past of the controller is copied to the front of its arrays."""

UNROLLED = ((1, 0), (5, 0), (6, 0), (6, 1), (7, 0))
"""Numbers of joints and of couplings of which the compiler unrolls the loops: those of the robots that are shipped.

The loop of any other number takes 1.3 to 2 times as long per joint (median of 15 runs of 10 s at 5 kHz)."""
_SIGNATURE = "Chain, Values, *[f8[:, ::1]] * 5, f8[::1], i8, *[f8[:, ::1]] * 2, f8, f8[::1], *[f8[:, ::1]] * 4, {}, {}"
_COUNTS = [("u1[::1]", "u1[::1]"), *((f"Tuple([i8] * {n})", f"Tuple([i8] * {pairs})") for n, pairs in UNROLLED)]


@dataclass(frozen=True, eq=False)
class Simulation:
    """Simulated motion; all arrays (N, n), SI, joint side, NaN from ``diverged_at`` on.

    ``qdd``: mean of the values just before and after the torque changes. ``tau``: held during ``[k, k + 1)``.
    ``diverged_at``: state not finite, velocity above its limit or mass matrix not positive definite; ``None``: never.
    """

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    diverged_at: int | None


def simulate(
    model: ArmModel,
    theta_base: ArrayLike,
    controller: DiscreteController,
    q_ref: ArrayLike,
    dt: float,
    *,
    q0: ArrayLike | None = None,
    qd0: ArrayLike | None = None,
    max_velocity: ArrayLike | None = None,
    disturbance: ArrayLike | None = None,
    inertia: ArrayLike | None = None,
) -> Simulation:
    """Simulate the arm, without its terms, under its controller along a reference (thesis equation 2.9, section B.3).

    A torque is held for one period. ``q0``, ``qd0``: first state (n,), by default that of the reference; before it,
    tracking error and velocity were constant. ``max_velocity``: diverged above it, by default ten times the limits.
    ``disturbance``: motor torques (N, n) added after saturation, part of ``tau``. ``inertia``: additional, joints (n,).
    """
    reference = np.ascontiguousarray(q_ref, dtype=np.float64)
    samples, n = reference.shape
    if n != model.n or controller.n != n or samples < 1:
        raise ValueError(
            f"expected {model.n} joints and at least one sample: the reference has shape {reference.shape}, "
            f"the controller {controller.n} motors"
        )
    if abs(controller.dt - dt) > 1e-9 * dt:
        raise ValueError(f"the controller runs every {controller.dt} s, the simulation every {dt} s")
    pushed = np.zeros((0, n)) if disturbance is None else np.ascontiguousarray(disturbance, dtype=np.float64)
    if disturbance is not None and pushed.shape != reference.shape:
        raise ValueError(f"the disturbance has shape {pushed.shape}, the reference {reference.shape}")
    if max_velocity is None:
        max_velocity = [RUNAWAY * joint.limits.velocity for joint in model.robot.joints]
    start = reference[0] if q0 is None else np.asarray(q0, dtype=np.float64)
    if qd0 is None:
        qd0 = (reference[1] - reference[0]) / dt if samples > 1 else np.zeros(n)
    q, qd, qdd, tau = (np.empty((samples, n)) for _ in range(4))
    q[0], qd[0] = start, qd0
    transmission = np.ascontiguousarray(model.robot.transmission_matrix)
    values = model.values(theta_base)
    if inertia is not None:
        values = values._replace(ia=values.ia + np.asarray(inertia, dtype=np.float64))
    pairs = values.coupling_joints.shape[0]
    counts: Any = ((0,) * n, (0,) * pairs)
    if (n, pairs) not in UNROLLED:
        counts = (np.empty(n, np.uint8), np.empty(pairs, np.uint8))
    stopped = run(
        model.chain,
        values,
        transmission,
        np.ascontiguousarray(np.linalg.inv(transmission)),
        controller.error_taps,
        controller.position_taps,
        controller.output_taps,
        controller.saturation,
        controller.memory,
        reference @ transmission.T,
        pushed,
        dt,
        np.broadcast_to(np.asarray(max_velocity, dtype=np.float64), (n,)).copy(),
        q,
        qd,
        qdd,
        tau,
        *counts,
    )
    if stopped < 0:
        return Simulation(q, qd, qdd, tau, None)
    for signal in (q, qd, qdd, tau):
        signal[stopped:] = np.nan
    return Simulation(q, qd, qdd, tau, stopped)


@inlined
def friction(
    n: int,
    pairs: int,
    values: Values,
    v: Array,
    x: Array,
    bend: Array,
    steep: Array,
    force: Array,
    slope: Array,
    pair_slope: Array,
) -> None:
    """Compute friction torques and their derivatives with respect to velocity (thesis equations 2.7, B.1).

    ``x``, ``bend``, ``steep``: scratch, ``padded(n + pairs)``: argument, value and derivative of the arctangent.
    """
    g = values.smoothing
    for j in range(n):
        x[j] = g[j] * v[j]
    for m in range(pairs):
        i, j = values.coupling_joints[m, 0], values.coupling_joints[m, 1]
        x[n + m] = min(g[i], g[j]) * (v[i] + v[j])
    arctangents(x, bend, steep)
    for j in range(n):
        coulomb = TWO_OVER_PI * values.fc[j]
        force[j] = values.off[j] + values.fv[j] * v[j] + coulomb * bend[j]
        slope[j] = values.fv[j] + coulomb * g[j] * steep[j]
    for m in range(pairs):
        i, j = values.coupling_joints[m, 0], values.coupling_joints[m, 1]
        coulomb = TWO_OVER_PI * values.coupling[m, 2]
        common = coulomb * bend[n + m]
        pair = coulomb * min(g[i], g[j]) * steep[n + m]
        force[i] += values.coupling[m, 1] * v[j] + common
        force[j] += values.coupling[m, 1] * v[i] + common
        slope[i] += pair
        slope[j] += pair
        pair_slope[m] = pair + values.coupling[m, 1]


@inlined
def divisions(n: int, pairs: int, values: Values, v: Array, a: Array, dt: float) -> int:
    """Number of integration steps in one sample: more while a joint with Coulomb friction passes standstill."""
    most = 1
    for j in range(n):
        x, dx = values.smoothing[j] * v[j], values.smoothing[j] * a[j] * dt
        if values.fc[j] != 0.0 and abs(x) < abs(dx) + NEAR_STANDSTILL:
            most = max(most, 1 + int(STEPS_PER_UNIT * abs(dx)))
    for m in range(pairs):
        i, j = values.coupling_joints[m]
        g = min(values.smoothing[i], values.smoothing[j])
        x, dx = g * (v[i] + v[j]), g * (a[i] + a[j]) * dt
        if values.coupling[m, 2] != 0.0 and abs(x) < abs(dx) + NEAR_STANDSTILL:
            most = max(most, 1 + int(STEPS_PER_UNIT * abs(dx)))
    return min(most, MOST_STEPS)


@inlined
def stiffen(
    n: int, pairs: int, mass: Array, step: float, coupled: Ints, slope: Array, pair_slope: Array, stiff: Array
) -> None:
    """Lower triangle of the matrix of the implicit stages, ``mass + GAMMA step F`` with the friction derivative F."""
    for i in range(n):
        for j in range(i):
            stiff[i, j] = mass[i, j]
        stiff[i, i] = mass[i, i] + GAMMA * step * slope[i]
    for m in range(pairs):
        i, j = coupled[m, 0], coupled[m, 1]
        stiff[max(i, j), min(i, j)] += GAMMA * step * pair_slope[m]


@compiled(*(_SIGNATURE.format(*counts) for counts in _COUNTS), **ARITHMETIC)
def run(
    chain: Chain,
    values: Values,
    transmission: Array,
    inverse_transmission: Array,
    error_taps: Array,
    position_taps: Array,
    output_taps: Array,
    saturation: Array,
    memory: int,
    reference: Array,
    disturbance: Array,
    dt: float,
    max_velocity: Array,
    q: Array,
    qd: Array,
    qdd: Array,
    tau: Array,
    joints: Sized,
    couplings: Sized,
) -> int:
    """Simulate the closed loop; fill ``q, qd, qdd, tau`` from the state in the first row of ``q`` and ``qd``.

    Returns the sample at which the simulation stopped, or -1. ``joints``, ``couplings``: of these lengths; if they are
    tuples, loops are unrolled. ``memory``: samples that the controller uses. ``disturbance``: no rows if none.
    """
    samples, n = reference.shape[0], len(joints)
    coupled = values.coupling_joints
    pairs = len(couplings)
    work, factor, stiff_factor = np.empty((n, 6)), np.empty((n, n)), np.empty((n, n))
    mass, mass_before, middle_mass, stiff = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    angle, sine, cosine = np.zeros(padded(n)), np.empty(padded(n)), np.empty(padded(n))
    terms = padded(n + pairs)
    x, bend, steep = np.zeros(terms), np.empty(terms), np.empty(terms)
    bias, bias_before, still = np.empty(n), np.empty(n), np.zeros(n)
    load, k1, k2, middle, rate = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    # State and torque have their own arrays: creating a view of a row takes longer than copying the row.
    p, v, held, drive = q[0].copy(), qd[0].copy(), np.empty(n), np.empty(n)
    disturbed = disturbance.shape[0] > 0
    force, slope, pair_slope = np.empty(n), np.empty(n), np.empty(pairs)
    force_middle, slope_middle, pair_slope_middle = np.empty(n), np.empty(n), np.empty(pairs)
    # The newest sample is in row ``now``; after the last row, the most recent ones are copied to the front.
    rows = memory + HISTORY
    error, position, output = np.empty((rows, n)), np.empty((rows, n)), np.empty((rows, n))
    now = memory - 2
    for k in range(samples):
        for j in range(n):
            if not (np.isfinite(p[j]) and abs(v[j]) <= max_velocity[j]):
                return k
        turn(n, chain, p, angle, sine, cosine)
        rigid_torque(n, chain, values, p, v, still, sine, cosine, work, bias)
        fill_mass_matrix(n, chain, values, p, sine, cosine, mass)
        friction(n, pairs, values, v, x, bend, steep, force, slope, pair_slope)
        now += 1
        if now == rows:
            for m in range(memory - 1):
                for i in range(n):
                    error[m, i] = error[now - memory + 1 + m, i]
                    position[m, i] = position[now - memory + 1 + m, i]
                    output[m, i] = output[now - memory + 1 + m, i]
            now = memory - 1
        for i in range(n):
            here = 0.0
            for j in range(n):
                here += transmission[i, j] * p[j]
            error[now, i], position[now, i] = reference[k, i] - here, here
        if k == 0:
            for i in range(n):
                bias_before[i] = bias[i]
                for j in range(i + 1):
                    mass_before[i, j] = mass[i, j]
                balance = speed = 0.0
                for j in range(n):
                    balance += inverse_transmission[j, i] * (bias[j] + force[j])
                    speed += transmission[i, j] * v[j]
                for back in range(1, memory):
                    error[now - back, i] = error[now, i]
                    position[now - back, i] = position[now, i] - back * dt * speed
                    output[now - back, i] = balance
        for i in range(n):
            nu = 0.0
            for m in range(error_taps.shape[1]):
                nu += error_taps[i, m] * error[now - m, i]
            for m in range(position_taps.shape[1]):
                nu += position_taps[i, m] * position[now - m, i]
            for m in range(output_taps.shape[1]):
                nu += output_taps[i, m] * output[now - 1 - m, i]
            nu = min(max(nu, -saturation[i]), saturation[i])
            output[now, i] = nu
            drive[i] = nu + disturbance[k, i] if disturbed else nu
        for j in range(n):
            torque = 0.0
            for i in range(n):
                torque += transmission[i, j] * drive[i]
            before = held[j] if k > 0 else torque
            held[j] = tau[k, j] = torque
            rate[j] = 0.5 * (before + torque) - bias[j] - force[j]
        for i in range(n):
            load[i] = held[i] - (1.5 * bias[i] - 0.5 * bias_before[i])
            bias_before[i] = bias[i]
            for j in range(i + 1):
                middle_mass[i, j] = 1.5 * mass[i, j] - 0.5 * mass_before[i, j]
                mass_before[i, j] = mass[i, j]
        # Usually one step covers the sample: factor its matrix here, so that both factorisations overlap in the CPU.
        stiffen(n, pairs, middle_mass, dt, coupled, slope, pair_slope, stiff)
        if not cholesky(mass, factor, n):
            return k
        solvable = cholesky(stiff, stiff_factor, n)
        for i in range(n):
            k1[i] = load[i] - force[i]
        solve_factored(factor, n, rate)
        solve_factored(stiff_factor, n, k1)
        for i in range(n):
            qdd[k, i] = rate[i]
        if k + 1 == samples:
            break
        steps = divisions(n, pairs, values, v, rate, dt)
        h = dt / steps
        for _ in range(steps):
            if steps > 1:
                friction(n, pairs, values, v, x, bend, steep, force, slope, pair_slope)
                stiffen(n, pairs, middle_mass, h, coupled, slope, pair_slope, stiff)
                solvable = cholesky(stiff, stiff_factor, n)
                for i in range(n):
                    k1[i] = load[i] - force[i]
                solve_factored(stiff_factor, n, k1)
            if not solvable:
                return k + 1
            for i in range(n):
                middle[i] = v[i] + 0.5 * h * k1[i]
            friction(n, pairs, values, middle, x, bend, steep, force_middle, slope_middle, pair_slope_middle)
            # M k1 = load - force - gamma h F k1 makes the product with the mass matrix unnecessary.
            for i in range(n):
                k2[i] = force[i] - force_middle[i] + GAMMA * h * slope[i] * k1[i]
            for m in range(pairs):
                i, j = coupled[m, 0], coupled[m, 1]
                k2[i] += GAMMA * h * pair_slope[m] * k1[j]
                k2[j] += GAMMA * h * pair_slope[m] * k1[i]
            solve_factored(stiff_factor, n, k2)
            for i in range(n):
                new = v[i] + h * (k1[i] + k2[i])
                p[i] += 0.5 * h * (v[i] + new)
                v[i] = new
        for i in range(n):
            q[k + 1, i], qd[k + 1, i] = p[i], v[i]
    return -1
