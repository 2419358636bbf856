"""Table 4.8: elevator loop of an aircraft, whose outputs are more sensitive than its input (thesis section 4.3.2).

The thesis takes the McDonnell Douglas F-4C Phantom at Mach 1.1 of Cook, Flight Dynamics Principles (2007), example
11.6, with the loop of figure 4.6: the elevator follows the pilot and the pitch rate. It states the doublet (1.3
Hz, 5 degrees) and the parameters, those of the short-period mode; the sampling rate and the duration are not stated.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]

STATE = np.array(
    [
        [-0.068, -0.011, 0.0, -9.81],
        [0.023, -2.10, 375.0, 0.0],
        [0.011, -0.160, -2.20, 0.0],
        [0.0, 0.0, 1.0, 0.0],
    ]
)
"""State matrix: axial velocity u, normal velocity w (m/s), pitch rate q (rad/s), pitch angle (rad)."""
ELEVATOR = np.array([-0.41, -77.0, -61.0, 0.0])
"""Input vector, per radian of the elevator."""
HEAVE, PITCH = 1, 2
RATE_GAIN = -0.12
"""Elevator angle per pitch rate, rad per rad/s (figure 4.6): ``delta = delta_pilot - RATE_GAIN q``."""
PARAMETERS = ("zw", "zq", "mw", "mq", "z_delta", "m_delta")
DOUBLET_HZ = 1.3
DOUBLET = np.deg2rad(5.0)
DURATION = 10.0
"""Duration of the simulation, s; not stated by the thesis."""
SAMPLING_HZ = 250.0
"""Sampling rate, not stated by the thesis. Singular values grow with its square root, condition numbers do not; at this
rate the largest singular value of CLOE is that of the thesis."""


@dataclass(frozen=True)
class AircraftSensitivity:
    """Singular values (6,) in descending order. ``clie``: of the elevator angle; ``cloe``: of w and q together."""

    clie: Array
    cloe: Array


def aircraft_sensitivity(sampling_hz: float = SAMPLING_HZ, duration: float = DURATION) -> AircraftSensitivity:
    """Return the singular values of the closed loop's Jacobians with respect to ``PARAMETERS`` (SI, angles in rad).

    The sensitivities are additional states, ``ds/dt = A_c s + (dA_c/dtheta) x + (db/dtheta) delta_pilot``, without
    finite differences. The doublet switches at samples; the discretisation is exact.

    ``sampling_hz``: sampling rate, Hz.
    """
    gain = np.zeros(4)
    gain[PITCH] = RATE_GAIN
    closed = STATE - np.outer(ELEVATOR, gain)
    slopes: list[tuple[Array, Array]] = []
    for row, name in zip((HEAVE, HEAVE, PITCH, PITCH, HEAVE, PITCH), PARAMETERS, strict=True):
        by_state, by_elevator = np.zeros((4, 4)), np.zeros(4)
        if name.endswith("delta"):
            by_elevator[row] = 1.0
        else:
            by_state[row, HEAVE if name.endswith("w") else PITCH] = 1.0
        slopes.append((by_state - np.outer(by_elevator, gain), by_elevator))
    b = len(slopes)
    # States: the aircraft, its derivative with respect to each parameter, and the constant pilot input.
    system = np.zeros((4 * (b + 1) + 1,) * 2)
    for k in range(b + 1):
        block = slice(4 * k, 4 * k + 4)
        system[block, block] = closed
        if k:
            system[block, :4] = slopes[k - 1][0]
        system[block, -1] = slopes[k - 1][1] if k else ELEVATOR
    step = expm(system / sampling_hz)
    samples = round(duration * sampling_hz) + 1
    half = round(sampling_hz / (2 * DOUBLET_HZ))
    order = np.zeros(samples)
    order[:half], order[half : 2 * half] = DOUBLET, -DOUBLET
    state, motion = np.zeros(len(system)), np.empty((samples, b, 4))
    for k in range(samples):
        motion[k] = state[4:-1].reshape(b, 4)
        state[-1] = order[k]
        state = step @ state
    elevator_angle = -motion[:, :, PITCH] * RATE_GAIN
    outputs = np.concatenate([motion[:, :, HEAVE], motion[:, :, PITCH]])
    return AircraftSensitivity(
        clie=np.asarray(np.linalg.svd(elevator_angle, compute_uv=False), dtype=np.float64),
        cloe=np.asarray(np.linalg.svd(outputs, compute_uv=False), dtype=np.float64),
    )
