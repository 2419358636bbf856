"""Closed-loop simulation of an arm whose model has further terms, by waveform relaxation.

The compiled loop knows the rigid arm with friction. What a term adds is computed along the whole simulated motion,
taken for a load on the next simulation, and so on until the motion stays (Lelarasmee, Ruehli, Sangiovanni-Vincentelli
1982): a controller that tracks its reference makes the motion depend so little on the load that a few rounds are
enough. Any effect of the catalogue, also one with a memory of its own, so has a place in the simulation by its columns
alone.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from identify.model.arm import ArmModel
from identify.model.chain import Floats
from identify.model.controller import DiscreteController
from identify.model.simulation import Simulation, simulate

ROUNDS = 8
"""Most simulations."""

SETTLED = 1e-3
"""Change of the terms' torque from one round to the next, over its size, that ends the rounds."""


def simulate_with_terms(
    model: ArmModel,
    theta_base: ArrayLike,
    controller: DiscreteController,
    q_ref: ArrayLike,
    dt: float,
    *,
    start: float = 0.0,
    disturbance: ArrayLike | None = None,
    **initial: Any,
) -> Simulation:
    """Simulate like :func:`identify.model.simulation.simulate`, the terms of the model included.

    Parameters
    ----------
    theta_base
        Base (b,) or standard (p,) parameters; the last e are those of the terms.
    start
        Time of the first sample since the recordings began, s.

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
    run, change = None, np.inf
    for _ in range(ROUNDS):
        again = simulate(model, theta, controller, reference, dt, disturbance=pushed - load @ to_motors, **initial)
        if again.diverged_at is not None:
            return again if run is None else run
        torque = known.term_regressor(known.motion(again.q, again.qd, again.qdd, dt, start)) @ values
        # A torque held over a period acts like its mean between two samples.
        held = torque.copy()
        held[:-1] = 0.5 * (torque[1:] + torque[:-1])
        step = float(np.linalg.norm(held - load)) / max(float(np.linalg.norm(held)), 1e-300)
        settled = replace(again, tau=again.tau + load)
        if step > change:
            # Too stiff for relaxation: the best round so far stays.
            return run if run is not None else settled
        run, load, change = settled, held, step
        if step < SETTLED:
            break
    assert run is not None
    return run
