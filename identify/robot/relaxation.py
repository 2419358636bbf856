"""Closed-loop simulation of an arm whose model has additional terms, by waveform relaxation.

The torque of the terms along the whole simulated motion is the load of the next simulation, until it no longer changes
(Lelarasmee, Ruehli, Sangiovanni-Vincentelli 1982). Anderson mixing extrapolates each load from earlier ones (Anderson
1965, J. ACM 12(4)), so that terms of accelerations and torques converge, too. The part proportional to a joint's own
acceleration acts as inertia, which the compiled simulation includes at every instant. An effect needs only its
regressor columns, even with internal states.
"""

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation, simulate
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.differentiate import Derivatives

ROUNDS = 16
"""Maximum number of simulations: loops whose load converges take eight or fewer (tests of `identify/effects`)."""

RATE = 20.0
"""Rate at which the torque of the terms is computed, over its band: harmonics up to the tenth stay below half of it."""

SETTLED = 1e-3
"""Difference between the torque of the terms and the applied load, over that torque, at which the iteration ends."""

INERTIA_POSTURES = 100
"""Approximate number of postures of a motion at which the joint inertias are evaluated: 20 and 1000 give the same
motions to 2e-5 of what the terms change."""

MEMORY = 6
"""Number of earlier simulations from which the next load is extrapolated: the slowest of these loops takes 16
simulations with two, ten with four, eight with six, and eight with ten."""

FELT_INERTIA = 0.1
"""Inertia added by terms, relative to the joint's own, above which the compiled simulation includes it: as a
load, a large one takes three times as many simulations."""

LEAST_INERTIA = 0.4
"""Fraction of its own inertia that a joint keeps at least in the compiled simulation if terms reduce inertia. The gain
of its loop grows by the inverse, 2.5; usual gain margins are 2 to 5 (Astrom and Murray 2008, section 9.3)."""

STEP = 1.0
"""Mixing factor: fraction of the remaining difference that is added to the extrapolated load. A loop answers a load by
a small part of it, so that the whole difference is nearly right at once; Anderson mixing corrects the rest."""


def simulate_with_terms(
    model: ArmModel,
    theta_base: ArrayLike,
    controller: DiscreteController,
    q_ref: ArrayLike,
    dt: float,
    *,
    start: float = 0.0,
    disturbance: ArrayLike | None = None,
    band_hz: float = np.inf,
    rounds: int = ROUNDS,
    tolerated: float = 0.0,
    motion: Derivatives | None = None,
    **initial: Any,
) -> Simulation:
    """Simulate the closed loop with the terms of the model; see :func:`armident.identify.robot.simulation.simulate`.

    ``band_hz``: low-pass for the torque of the terms: references in steps would prevent convergence. ``tolerated``:
    difference of the terms' torque and the load, over each joint's torque, that suffices. ``motion``: for the first
    load; ``None``: no load. ``tau`` of the result is what the drives report: rigid arm plus terms.
    """
    theta = np.asarray(theta_base, dtype=np.float64)
    values = theta[theta.size - model.e :]
    if not values.any():
        return simulate(model, theta, controller, q_ref, dt, disturbance=disturbance, **initial)
    to_motors = np.linalg.inv(model.robot.transmission_matrix)
    known = model if model.anchor is not None else model.anchored(theta)
    reference = np.ascontiguousarray(q_ref, dtype=np.float64)
    pushed = np.zeros_like(reference) if disturbance is None else np.asarray(disturbance, dtype=np.float64)
    # One instant of ``step``: the torque is needed in its band only.
    step = max(1, int(1.0 / (dt * RATE * band_hz)))
    load: Array = np.zeros_like(reference[::step])
    inertia: Array = np.zeros(model.n)
    best: tuple[float, Simulation, Array] | None = None
    past = _Past()

    def torque_at(run: Simulation | Derivatives) -> Array:
        q, qd, qdd = (np.ascontiguousarray(x[::step]) for x in (run.q, run.qd, run.qdd))
        return known.term_torque(known.motion(q, qd, qdd, step * dt, start), values)

    def answer_of(torque: Array, run: Simulation | Derivatives) -> Array:
        # The load is held during each period: take the torque in its middle.
        rest = torque - run.qdd[::step] * inertia
        rest[:-1] += 0.5 / step * (rest[1:] - rest[:-1])
        return _slow(rest, step * dt, band_hz)

    def felt(torque: Array, run: Simulation | Derivatives) -> Array:
        slow = (_slow(x, step * dt, band_hz) for x in (torque, run.qdd[::step]))
        return _inertia(model, theta, run.q, *slow)

    def at_samples(load: Array) -> Array:
        at, known_at = np.arange(reference.shape[0]), step * np.arange(load.shape[0])
        return np.stack([np.interp(at, known_at, own) for own in load.T], axis=1)

    if motion is not None:
        torque = torque_at(motion)
        inertia = felt(torque, motion)
        load = answer_of(torque, motion)
    # Where a loop diverges, the given motion may be far from its own: begin without load. Then leave the inertia out.
    begins, restarts = motion is None, 0
    most = 1 if begins else 2
    for _ in range(rounds):
        applied = at_samples(load)
        pushes = pushed - applied @ to_motors
        run = simulate(model, theta, controller, reference, dt, disturbance=pushes, inertia=inertia, **initial)
        if run.diverged_at is not None:
            if best is not None:
                load = 0.5 * (load + best[2])
                continue
            if restarts == most or not (load.any() or inertia.any()):
                return run
            restarts += 1
            begins = restarts < most
            load, inertia = np.zeros_like(load), np.zeros(model.n)
            continue
        torque = torque_at(run)
        if begins:
            inertia = felt(torque, run)
        answer = answer_of(torque, run)
        if begins and inertia.any():
            load, begins = answer, False
            continue
        begins = False
        missing = answer - load
        apart = float(np.linalg.norm(missing)) / max(float(np.linalg.norm(answer)), 1e-300)
        if best is None or apart < best[0]:
            best = apart, replace(run, tau=run.tau + applied), load
        whole = (run.tau + applied)[::step]
        small = np.linalg.norm(missing, axis=0) <= tolerated * np.linalg.norm(whole, axis=0)
        if apart < SETTLED or small.all():
            break
        load = past.next(load, missing)
    assert best is not None
    return best[1]


def _slow(values: Array, dt: float, band_hz: float) -> Array:
    """Low-pass ``values`` (N, n) at ``band_hz``; unchanged if it is not below 0.45 of the sampling rate."""
    return butterworth(values, dt, band_hz) if band_hz < 0.45 / dt else values


def _inertia(model: ArmModel, theta: Array, q: Array, torque: Array, qdd: Array) -> Array:
    """Inertia (n,) of each joint that fits the torque (N, n) of the terms, zero where it is small; kg m^2 or kg."""
    found = np.sum(torque * qdd, axis=0) / np.maximum(np.sum(qdd * qdd, axis=0), 1e-300)
    postures = q[:: max(1, q.shape[0] // INERTIA_POSTURES)]
    own = np.maximum(np.einsum("kjj->kj", model.mass_matrix(theta, postures)).min(axis=0), 0.0)
    found = np.maximum(found, (LEAST_INERTIA - 1.0) * own)
    return np.where(np.abs(found) > FELT_INERTIA * own, found, 0.0)


class _Past:
    """Loads of the last simulations and their differences from the torque of the terms, for Anderson mixing."""

    def __init__(self) -> None:
        self._loads: deque[Array] = deque(maxlen=MEMORY)
        self._missing: deque[Array] = deque(maxlen=MEMORY)

    def next(self, load: Array, missing: Array) -> Array:
        """Return the next load (N, n): of least difference in a linear model, plus `STEP` times that difference."""
        self._loads.append(load)
        self._missing.append(missing)
        if len(self._loads) == 1:
            return load + STEP * missing
        loads, answers = (
            np.stack([b.ravel() - a.ravel() for a, b in zip(x, list(x)[1:], strict=False)], axis=1)
            for x in (self._loads, self._missing)
        )
        weights = np.linalg.lstsq(answers, missing.ravel(), rcond=1e-10)[0]
        guess: Array = load + STEP * missing - ((loads + STEP * answers) @ weights).reshape(load.shape)
        return guess
