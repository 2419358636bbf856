"""Closed-loop simulation of an arm whose model has further terms, by waveform relaxation.

The compiled loop knows the rigid arm with friction. What a term adds is computed along the whole simulated motion,
taken for a load on the next simulation, and so on until the motion stays (Lelarasmee, Ruehli, Sangiovanni-Vincentelli
1982). Each load is guessed from how the last ones answered (Anderson 1965, J. ACM 12(4)), so that terms that depend on
accelerations and torques settle, too; what goes with the acceleration of a joint is inertia that the compiled loop has
at every instant, however large. Any effect of the catalogue, also one with a memory of its own, so has a place in
the simulation by its columns alone.
"""

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import Simulation, simulate
from armident.identify.signals.bandpass import butterworth

ROUNDS = 16
"""Most simulations."""

SETTLED = 1e-3
"""Torque of the terms beside the load that they were simulated with, over its size, that ends the rounds."""

POSTURES = 100
"""Postures of a motion at which the inertia of its joints is looked at."""

MEMORY = 6
"""Rounds from which the next load is guessed."""

FELT_INERTIA = 0.1
"""Inertia that terms add to a joint, over its own, from which on the compiled loop has it."""

LEAST_INERTIA = 0.4
"""Share of its own that a joint keeps there where terms take inertia away."""

STEP = 0.5
"""Share of what is still missing from the load that goes into the next one, beyond the guess."""


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
    **initial: Any,
) -> Simulation:
    """Simulate like :func:`armident.identify.robot.simulation.simulate`, the terms of the model included.

    Parameters
    ----------
    theta_base
        Base (b,) or standard (p,) parameters; the last e are those of the terms.
    start
        Time of the first sample since the recordings began, s.
    band_hz
        The arm feels no more of the terms than what is slower than this: differentiated twice or thrice, the steps in
        which references arrive would keep the rounds from settling.

    Returns
    -------
    Simulation
        ``tau`` is what the drives report: the torque that moves the rigid arm, and that of the terms.
    """
    theta = np.asarray(theta_base, dtype=np.float64)
    values = theta[theta.size - model.e :]
    if not values.any():
        return simulate(model, theta, controller, q_ref, dt, disturbance=disturbance, **initial)
    to_motors = np.linalg.inv(model.robot.transmission_matrix)
    known = model if model.anchor is not None else model.anchored(theta)
    reference = np.ascontiguousarray(q_ref, dtype=np.float64)
    pushed = np.zeros_like(reference) if disturbance is None else np.asarray(disturbance, dtype=np.float64)
    load: Floats = np.zeros_like(reference)
    inertia: Floats = np.zeros(model.n)
    best: tuple[float, Simulation, Floats] | None = None
    past = _Past()
    for k in range(ROUNDS):
        pushes = pushed - load @ to_motors
        run = simulate(model, theta, controller, reference, dt, disturbance=pushes, inertia=inertia, **initial)
        if run.diverged_at is not None:
            if best is None and inertia.any():
                load, inertia = np.zeros_like(reference), np.zeros(model.n)
                continue
            if best is None:
                return run
            load = 0.5 * (load + best[2])
            continue
        torque = known.term_regressor(known.motion(run.q, run.qd, run.qdd, dt, start)) @ values
        if k == 0:
            inertia = _inertia(model, theta, run, _slow(torque, dt, band_hz), _slow(run.qdd, dt, band_hz))
        # A torque held over a period acts like its mean between two samples.
        held = torque - run.qdd * inertia
        held[:-1] = 0.5 * (held[1:] + held[:-1])
        held = _slow(held, dt, band_hz)
        if k == 0 and inertia.any():
            load = held
            continue
        missing = held - load
        apart = float(np.linalg.norm(missing)) / max(float(np.linalg.norm(held)), 1e-300)
        if best is None or apart < best[0]:
            best = apart, replace(run, tau=run.tau + load), load
        if apart < SETTLED:
            break
        load = past.next(load, missing)
    assert best is not None
    return best[1]


def _slow(values: Floats, dt: float, band_hz: float) -> Floats:
    """What is slower than a frequency, if sampling lets anything be faster."""
    return butterworth(values, dt, band_hz) if band_hz < 0.45 / dt else values


def _inertia(model: ArmModel, theta: Floats, run: Simulation, torque: Floats, qdd: Floats) -> Floats:
    """What of the terms' torque (N, n) goes with each joint's own acceleration, (n,), where it is worth its while."""
    found = np.sum(torque * qdd, axis=0) / np.maximum(np.sum(qdd * qdd, axis=0), 1e-300)
    postures = run.q[:: max(1, run.q.shape[0] // POSTURES)]
    own = np.maximum(np.einsum("kjj->kj", model.mass_matrix(theta, postures)).min(axis=0), 0.0)
    found = np.maximum(found, (LEAST_INERTIA - 1.0) * own)
    return np.where(np.abs(found) > FELT_INERTIA * own, found, 0.0)


class _Past:
    """Loads of the last rounds, and what was missing from them."""

    def __init__(self) -> None:
        self._loads: deque[Floats] = deque(maxlen=MEMORY)
        self._missing: deque[Floats] = deque(maxlen=MEMORY)

    def next(self, load: Floats, missing: Floats) -> Floats:
        """The load at which the least would be missing if it answered linearly, and a step from there."""
        self._loads.append(load)
        self._missing.append(missing)
        if len(self._loads) == 1:
            return load + STEP * missing
        loads, answers = (
            np.stack([b.ravel() - a.ravel() for a, b in zip(x, list(x)[1:], strict=False)], axis=1)
            for x in (self._loads, self._missing)
        )
        weights = np.linalg.lstsq(answers, missing.ravel(), rcond=1e-10)[0]
        guess: Floats = load + STEP * missing - ((loads + STEP * answers) @ weights).reshape(load.shape)
        return guess
