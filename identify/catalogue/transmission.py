"""Effects between motor and joint: elasticity, play, ripple."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from identify.catalogue.effect import Effect, Linear, Place, Shape
from identify.catalogue.motion import Motion

Array = NDArray[np.float64]

DAMPING = 0.05
"""Damping ratio taken for the resonance of an elastic joint: far below it, it does not show."""


def _cogging(motion: Motion, place: Place, *, harmonic: float) -> Array:
    angle = harmonic * motion.motor[:, place.joint]
    ripple = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ratios = motion.model.robot.transmission_matrix[place.joint]
    # At the motor's own joint, so that a coupled transmission hands the rest on in proportion.
    share: Array = ratios / ratios[int(np.argmax(np.abs(ratios)))]
    columns: Array = ripple[:, None, :] * share[:, None]
    return columns


def harmonics(motion: Motion, joint: int) -> Sequence[float]:
    """Harmonics of a motor turn; of a prismatic axis without a known pitch, wave numbers its travel can resolve."""
    if motion.model.robot.joints[joint].type == "revolute":
        return (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 18.0, 24.0)
    resolution = np.pi / float(motion.span[joint])
    return [float(resolution * k) for k in range(4, 161)]


def _elasticity(motion: Motion, place: Place, *, frequency: float) -> Array:
    """Load of a link behind a spring, less the load of a stiff one, both driven by the motor that is measured."""
    w = 2 * np.pi * frequency
    b, a = signal.bilinear([w**2], [1.0, 2 * DAMPING * w, w**2], 1 / motion.dt)
    load = motion.transmitted[:, place.joint]
    behind = signal.lfilter(b, a, load, zi=signal.lfilter_zi(b, a) * load[0])[0]
    column: Array = (behind - load)[:, None]
    return column


def frequencies(motion: Motion, joint: int) -> Sequence[float]:
    """Resonances up to a fifth of the sampling rate."""
    return [float(f) for f in np.geomspace(4.0, min(100.0, 0.2 / motion.dt), 10)]


def _backlash(motion: Motion, place: Place, *, threshold: float) -> Array:
    """The link stands half a gap behind the side of the teeth that carries, so the teeth's change of side moves it."""
    j = place.joint
    load = motion.transmitted[:, j]
    side = np.tanh(load / threshold)
    rate = motion.rate(side)
    shift = np.zeros_like(motion.q)
    shift[:, j] = -0.5 * side
    velocity, acceleration = np.zeros_like(shift), np.zeros_like(shift)
    velocity[:, j], acceleration[:, j] = -0.5 * rate, -0.5 * motion.rate(rate)
    moved: Array = motion.moved(shift, velocity, acceleration, links=True)[:, :, None]
    return moved


def loads(motion: Motion, joint: int) -> Sequence[float]:
    """Loads within which the teeth change sides: shares of the load's own spread."""
    spread = max(float(np.std(motion.transmitted[:, joint])), 1e-9)
    return [spread * share for share in (0.03, 0.1, 0.3)]


EFFECTS = (
    Effect(
        name="cogging_torque",
        title="a torque ripple over the motor's turn",
        says="a torque ripple that repeats with the motor angle: magnets of the motor, or an eccentric gear",
        reference="Petrovic et al. 2000, IEEE Trans. Power Electronics 15(6); Gandhi et al. 2002, ICRA",
        linear=(Linear("cgc", ("N m", "N")), Linear("cgs", ("N m", "N"))),
        shapes=(Shape("harmonic", ("per rad of the motor", "rad/m"), harmonics, continuous=False),),
        columns=_cogging,
        needs="slow motion over several motor turns",
        scope="motor",
        together=True,
        excitation=("slow", "range"),
    ),
    Effect(
        name="joint_elasticity",
        title="an elastic joint",
        says="the link swings behind its motor: an elastic gear, belt or coupling, or a bending link",
        reference="Spong 1987, J. Dyn. Sys. Meas. Control 109(4)",
        linear=(Linear("els", ("", ""), sign=1),),
        shapes=(Shape("frequency", ("Hz", "Hz"), frequencies),),
        columns=_elasticity,
        predicts=True,
        needs="quick accelerations near the resonance, under load",
        excitation=("accelerations",),
    ),
    Effect(
        name="backlash",
        title="play in the gear",
        says="the motor turns a little before the link follows whenever the load changes sides: worn teeth, a loose key",
        reference="Nordin, Gutman 2002, Automatica 38(10)",
        linear=(Linear("gap", ("rad", "m"), sign=1),),
        shapes=(Shape("threshold", ("N m", "N"), loads),),
        columns=_backlash,
        predicts=True,
        needs="many changes of the load's direction",
        excitation=("reversals", "accelerations"),
    ),
)
