"""Mistakes that the signals alone show: standstill, joints at rest, clipped torques, a rate too slow for the motion."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armident.configs import RobotConfig
from armident.identify.setup.plausible import NO_LIMIT
from armident.identify.setup.result import SetupFinding
from armident.identify.signals.experiments import Experiment

Array = NDArray[np.float64]

STILL_SHARE = 1e-3
"""Share of its position range below which a joint counts as not moving."""

HELD_SHARE = 0.01
"""Motion over that of the joint that moves most, in shares of ranges, below which a joint is held.

A held joint gives way to the torques of the others by less than a percent of their motion.
"""

STILL_RATIO = 0.7
"""Power of the differences over twice that of the positions above which they are noise (von Neumann 1941): 1 if white.

A sine with five samples per period has 0.69.
"""

LEAST_RUN = 5
"""Samples in a row at the extreme value that count as clipped: noise of one count keeps a value for fewer."""

RUN_RATIO = 3.0
"""Longest run at the extreme over the longest run at any other value while the joint moves."""

CLIPPED_SHARE = 2e-3
"""Least share of clipped samples for a finding."""

CLIPPED_UNUSABLE = 0.05
"""Share of clipped samples from which on results are unusable."""

REST_REMEDY = "record a motion of all joints: armident trajectory designs one"

CLIPPED_REMEDY = "record a gentler motion, or with a wider range of the torque signal"

POWER_SHARE = 0.95
"""Share of the velocity's power below the frequency of a motion."""

SIGNIFICANT = 10.0
"""Power over the floor of the encoder noise above which a frequency counts as motion."""

LEAST_SAMPLES = 10.0
"""Samples per period of the motion that accelerations need (Ljung 1999, System Identification, section 13.7)."""

SAMPLES_UNUSABLE = 5.0
"""Samples per period below which central differences lose a fifth of the acceleration."""


def moving_joints(experiments: Sequence[Experiment], robot: RobotConfig) -> NDArray[np.bool_]:
    """Return the mask (n,) of the joints that move. ``experiments``: SI, joint side."""
    usual = np.array([2 * np.pi if joint.type == "revolute" else 1.0 for joint in robot.joints])
    limits = np.array([j.limits.position[1] - j.limits.position[0] for j in robot.joints])
    whole = np.where(limits < NO_LIMIT, np.minimum(limits, usual), usual)
    share = np.max([np.ptp(e.q, axis=0) for e in experiments], axis=0) / whole
    wanted = share
    if all(e.q_ref is not None for e in experiments):
        wanted = np.max([np.ptp(e.q_ref, axis=0) for e in experiments if e.q_ref is not None], axis=0) / whole
    power = np.sum([np.var(e.q, axis=0) for e in experiments], axis=0)
    of_steps = np.sum([np.mean(np.diff(e.q, axis=0) ** 2, axis=0) for e in experiments], axis=0)
    moves = (share >= STILL_SHARE) & (wanted >= STILL_SHARE) & (share >= HELD_SHARE * min(share.max(), 1.0))
    moving: NDArray[np.bool_] = moves & (of_steps < 2 * STILL_RATIO * power)
    return moving


def rest_findings(moving: NDArray[np.bool_], robot: RobotConfig) -> list[SetupFinding]:
    """Return a finding if nothing moves, or if single joints are at rest."""
    names = tuple(joint.name for joint in robot.joints)
    if not moving.any():
        message = "no joint moves in these recordings, so that they determine no parameter"
        return [SetupFinding("standstill", names, 1.0, message, REST_REMEDY, True)]
    still = tuple(name for name, moves in zip(names, moving, strict=True) if not moves)
    if not still:
        return []
    verb = "does" if len(still) == 1 else "do"
    message = f"{', '.join(still)} {verb} not move: the recordings do not determine their inertia and friction"
    return [SetupFinding("joint_at_rest", still, 1.0, message, REST_REMEDY, False)]


def clipped_findings(
    experiments: Sequence[Experiment], robot: RobotConfig, moving: NDArray[np.bool_]
) -> list[SetupFinding]:
    """Return the torques that stay at an extreme value, or never change."""
    findings = []
    to_motors = np.linalg.inv(robot.transmission_matrix)
    at_motors = [e.tau @ to_motors for e in experiments]
    for j in np.flatnonzero(moving):
        name = robot.joints[j].name
        for torques in ([e.tau[:, j] for e in experiments], [tau[:, j] for tau in at_motors]):
            if max(float(np.ptp(tau)) for tau in torques) == 0.0:
                message = f"the torque of {name} never changes although the joint moves: its drive does not report it"
                remedy = "check the mapping of the torque in session and drive"
                findings.append(SetupFinding("torque_clipped", (name,), 1.0, message, remedy, True))
                break
            share, level = _clipped(torques, [e.q[:, j] for e in experiments])
            if share >= CLIPPED_SHARE:
                unit = "N m" if robot.joints[j].type == "revolute" else "N"
                message = f"the torque of {name} is clipped at {level:.4g} {unit} in {100 * share:.1f} % of the samples"
                unusable = share >= CLIPPED_UNUSABLE
                findings.append(SetupFinding("torque_clipped", (name,), 1.0, message, CLIPPED_REMEDY, unusable))
                break
    return findings


def _clipped(torques: Sequence[Array], positions: Sequence[Array]) -> tuple[float, float]:
    """Share of the samples in long runs at the largest or the least torque, and that torque."""
    high, low = max(float(t.max()) for t in torques), min(float(t.min()) for t in torques)
    tolerance = 1e-9 * max(high - low, 1e-300)
    at, elsewhere, level, extreme = 0, 0, high, 0
    total = sum(t.size for t in torques)
    for tau, q in zip(torques, positions, strict=True):
        step = np.abs(np.gradient(q))
        still = np.concatenate([[0], np.cumsum(step <= 0.02 * step.max())])
        begins, ends = _runs(tau, tolerance)
        values, lengths = tau[begins], ends - begins
        outermost = (values >= high - tolerance) | (values <= low + tolerance)
        clipped = np.where(outermost & (lengths >= LEAST_RUN), lengths, 0)
        at += int(clipped.sum())
        if clipped.max(initial=0) > extreme:
            extreme, level = int(clipped.max()), float(values[np.argmax(clipped)])
        others = lengths[~outermost & (still[ends] == still[begins])]
        elsewhere = max(elsewhere, int(others.max(initial=0)))
    certain = extreme >= max(LEAST_RUN, RUN_RATIO * elsewhere)
    return (at / total if certain else 0.0), level


def _runs(x: Array, tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Runs of equal values: first samples and those after the last."""
    cuts = np.flatnonzero(np.abs(np.diff(x)) > tolerance) + 1
    begins, ends = np.concatenate([[0], cuts]), np.concatenate([cuts, [x.size]])
    long = ends - begins >= 2
    return begins[long], ends[long]


def rate_findings(experiments: Sequence[Experiment], robot: RobotConfig) -> list[SetupFinding]:
    """Return a finding if the motion has fewer than ten samples per period. ``experiments``: SI, joint side."""
    dt = experiments[0].dt
    highest = np.max([velocity_frequency(e.q, dt) for e in experiments], axis=0)
    slow = np.flatnonzero(highest * dt * LEAST_SAMPLES > 1.0)
    if not slow.size:
        return []
    names = tuple(robot.joints[j].name for j in slow)
    most = float(highest[slow].max())
    message = (
        f"the sampling rate of {1 / dt:.4g} Hz is too slow for the motion of {', '.join(names)}: {POWER_SHARE:.0%} of "
        f"the velocity's power lies below {most:.3g} Hz, which needs {LEAST_SAMPLES * most:.3g} Hz"
    )
    unusable = most * dt * SAMPLES_UNUSABLE > 1.0
    return [SetupFinding("rate_too_slow", names, 1.0, message, "record faster, or a slower motion", unusable)]


def velocity_frequency(q: Array, dt: float) -> Array:
    """Return the frequency (n,), Hz, below which `POWER_SHARE` of each joint's velocity power lies."""
    frequency, power = signal.periodogram(np.diff(q, axis=0) / dt, 1 / dt, window="hann", axis=0)
    frequency, power = frequency[1:], power[1:]
    position = power / (2 - 2 * np.cos(2 * np.pi * frequency * dt))[:, None]
    # A tenth of the spectrum is free of motion where the rate suffices; noise is white in the position.
    floor = np.quantile(position, 0.05, axis=0) / 0.0513
    cumulative = np.cumsum(np.where(position > SIGNIFICANT * floor, power, 0.0), axis=0)
    # A constant velocity is motion, too: its power lies at zero.
    cumulative += np.mean(np.diff(q, axis=0) / dt, axis=0) ** 2 / frequency[0]
    out = np.zeros(q.shape[1])
    for j in np.flatnonzero(cumulative[-1] > 0):
        out[j] = frequency[np.searchsorted(cumulative[:, j], POWER_SHARE * cumulative[-1, j])]
    return out
