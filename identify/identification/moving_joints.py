"""Joints that move in a recording, and joints at rest."""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array, Mask
from armident.configs import DataError, RobotConfig
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.signals.differentiate import encoder_resolution
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import mapped

NOISE_SAMPLES = 100_000
"""Samples from which the position noise is estimated."""

FARTHEST = 1e3
"""Position limit, rad or m, beyond which a joint counts as endless and its recorded range is used."""

MOVE = "move every joint over more of its range, at several speeds: armident trajectory --config ROBOT --out TRAJECTORY"


def joint_ranges(experiments: Sequence[Experiment]) -> Array:
    """Range of the measured position of each joint, shape (n,), rad or m. ``experiments``: recordings of one robot."""
    return _ranges(mapped(lambda e: e.q, experiments))


def moving_joints(experiments: Sequence[Experiment], robot: RobotConfig, criteria: IdentificationCriteria) -> Mask:
    """Mask (n,) of the joints that move: beyond the limits of ``criteria``, and with a reference that does not rest."""
    ranges = joint_ranges(experiments)
    limits = np.array([joint.limits.position for joint in robot.joints], dtype=np.float64)
    least = criteria.rest_noise_std * np.max([_position_noise(e.q) for e in experiments], axis=0)
    widths = np.where(np.abs(limits).max(axis=1) < FARTHEST, limits[:, 1] - limits[:, 0], 0.0)
    least = np.maximum(least, criteria.rest_limit_share * widths)
    counts = np.zeros(robot.n)
    if all(joint.drive.counts_per_unit is not None for joint in robot.joints):
        counts = criteria.rest_counts * encoder_resolution(robot)
    moving = ranges > np.maximum(least, counts)
    if all(e.q_ref is not None for e in experiments):
        moving &= _ranges(mapped(lambda e: e.q_ref, experiments)) > counts
    kinds = np.array([joint.type for joint in robot.joints])
    for kind in set(kinds.tolist()):
        same = kinds == kind
        moving[same] &= ranges[same] > criteria.rest_share * ranges[same].max()
    return np.asarray(moving, dtype=np.bool_)


def require_motion(experiments: Sequence[Experiment], robot: RobotConfig, moving: Mask) -> None:
    """Raise DataError, with the largest range, if no joint moves."""
    if moving.any():
        return
    ranges = joint_ranges(experiments)
    widest = int(np.argmax(ranges))
    unit = "rad" if robot.joints[widest].type == "revolute" else "m"
    raise DataError(
        f"No joint moves (largest range: {ranges[widest]:.2g} {unit} at {robot.joints[widest].name}), so no parameter "
        f"can be identified. Next: {MOVE}"
    )


def _ranges(signals: Sequence[Array]) -> Array:
    """Range (n,) of signals (N, n) of several experiments."""
    extremes = np.array([(signal.min(axis=0), signal.max(axis=0)) for signal in signals])
    return np.asarray(extremes[:, 1].max(axis=0) - extremes[:, 0].min(axis=0), dtype=np.float64)


def _position_noise(q: Array) -> Array:
    """Standard deviation (n,) of white position noise, from second differences of the first samples by their median."""
    q = q[:NOISE_SAMPLES]
    if q.shape[0] < 3:
        return np.zeros(q.shape[1])
    return np.asarray(np.median(np.abs(np.diff(q, 2, axis=0)), axis=0) / (0.6745 * np.sqrt(6.0)), dtype=np.float64)
