"""Uninterrupted stretches of motion for fit and test."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.signals.differentiate import Derivatives

USUAL = 0.95
"""Quantile of the velocity of a joint that counts as its speed in a recording."""
KINDS = ("measured", "simulated")
"""Kinds of motion of a stretch."""


@dataclass(frozen=True, eq=False)
class MotionStretch:
    """One uninterrupted stretch of motion at the working rate (N samples), SI, joint side.

    ``simulated``: motion of the simulated closed loop without noise: instruments. ``y`` (M, n), ``t`` (M,): torques and
    instants in the band of the comparison; ``torque`` (N, n): the full band. ``rows``: samples in its experiment;
    ``span``: after decimation to the working rate. ``before``: motion before the stretch, where effects with internal
    states start. ``moving`` (M, n): false where a joint stands still. ``noise`` (n,): size of the noise of each joint
    here beside that in all stretches; ``y`` is divided by it, as all equations are.
    """

    measured: Derivatives
    simulated: Derivatives
    y: Array
    torque: Array
    t: Array
    experiment: int
    rows: NDArray[np.int64]
    span: slice
    moving: NDArray[np.bool_]
    noise: Array
    before: tuple[Derivatives, Derivatives] | None = None

    @property
    def weights(self) -> Array:
        """Weights of the equations, (M, n): zero where a joint stands still, else one over the size of the noise."""
        return self.moving / self.noise

    @property
    def torques(self) -> Array:
        """Torques in the band of the comparison, (M, n), N m or N."""
        return self.y * self.noise

    def with_noise(self, noise: Array) -> "MotionStretch":
        """Return the stretch with another size of the noise of each joint, (n,)."""
        return replace(self, y=self.y * (self.noise / noise), noise=noise)

    def resimulated(self, motion: Derivatives, dt: float, factor: int) -> "MotionStretch":
        """Stretch with another simulation of the whole experiment, decimated by ``factor`` to the working rate."""
        simulated = replace(at_rows(motion, self.rows, dt, factor), start=self.simulated.start)
        if self.before is None:
            return replace(self, simulated=simulated)
        measured, old = self.before
        earlier = np.arange(self.rows[0] - factor * old.q.shape[0], self.rows[0], factor)
        return replace(
            self, simulated=simulated, before=(measured, replace(at_rows(motion, earlier, dt, factor), start=old.start))
        )


def at_rows(signals: Derivatives, rows: NDArray[np.int64], dt: float, factor: int) -> Derivatives:
    """Signals at samples ``rows`` (N,), which are ``factor`` sampling periods ``dt`` apart."""
    return Derivatives(
        np.ascontiguousarray(signals.q[rows]),
        np.ascontiguousarray(signals.qd[rows]),
        np.ascontiguousarray(signals.qdd[rows]),
        signals.nvr,
        dt * factor,
        signals.start + dt * float(rows[0]),
    )


def rows_before(kept: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Samples before a stretch, as many as it has itself if there are enough."""
    first = int(np.searchsorted(kept, rows[0]))
    return kept[max(first - rows.size, 0) : first]


def distances(stretches: Sequence[MotionStretch]) -> Array:
    """Squared errors of the simulated velocities of each joint over its own measured ones, (n,)."""
    apart = sum(np.sum((s.simulated.qd - s.measured.qd) ** 2, axis=0) for s in stretches)
    size = sum(np.sum(s.measured.qd**2, axis=0) for s in stretches)
    return np.asarray(apart / np.maximum(size, 1e-300))


def usual_speeds(qd: Array) -> Array:
    """Return the speed of each joint in a recording, (n,), without the short push of a loop that is switched on."""
    return np.asarray(np.quantile(np.abs(qd), USUAL, axis=0))


def dragged_joints(speeds: Array, fastest: Array, slow: float) -> NDArray[np.bool_]:
    """Return true for joints that the others only drag in a recording, (n,): their equations are no evidence.

    Dry friction holds such a joint; how it creeps depends on more than a model knows. ``speeds`` (n,): in the
    recording; ``fastest`` (n,): in the recording where the joint moves most. Below the share ``slow`` of that, a joint
    is dragged if another one moves twice as much.
    """
    share = speeds / np.maximum(fastest, 1e-300)
    return np.asarray(share < min(slow, 0.5 * float(share.max())))


def moving_rows(qd: Array, slowest: Array, width: int, instants: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return false where a joint stands still, (M, n): its dry friction is undetermined there.

    It stays slower than its smoothed sign's width ``slowest`` (n,) for ``width`` samples to either side.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    still = minimum_filter1d((np.abs(qd) < slowest).astype(np.int8), 2 * width + 1, axis=0, mode="nearest")
    spread = maximum_filter1d(still, 8 * width + 1, axis=0, mode="nearest")
    return np.asarray(spread[instants] == 0)
