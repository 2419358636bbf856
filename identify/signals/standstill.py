"""Which samples are too slow to tell Coulomb from viscous friction.

Near standstill nobody knows the shape of the friction: the smoothed sign of a simulation, the sharp one of a published
fit and the true one differ there and nowhere else, and what is wrong there moves Fc one way and Fv the other. Where the
smoothed sign is the true one all equations may stay, without bias. Where that is not known, equations are left out
after the parallel filter, which itself needs all samples, if the filter put slow samples into them: smoothed and sharp
sign, which differ by up to five standard deviations of Fv and Fc with all equations, then agree within about one. What
still changes with the threshold is friction that is no straight line.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives

SLOW_SHARE = 0.02
"""Speed in root mean squares of a joint's velocity below which a sample counts as slow."""


def velocity_threshold(signals: Sequence[Derivatives], share: float = SLOW_SHARE) -> NDArray[np.float64]:
    """Speed of each joint under which its equations are better left out, shape (n,), rad/s or m/s.

    Parameters
    ----------
    signals
        Derivatives of every experiment; the root mean square is that of all together.
    share
        Of the root mean square of the velocity; 0 leaves nothing out.

    Raises
    ------
    DataError
        If there are no signals, or the share is not in [0, 1).
    """
    if not signals:
        raise DataError("velocity threshold: no signals")
    if not 0 <= share < 1:
        raise DataError(f"velocity threshold: expected a share of the rms velocity in [0, 1), got {share:g}")
    samples = sum(s.qd.shape[0] for s in signals)
    squares = np.sum([np.sum(s.qd**2, axis=0) for s in signals], axis=0)
    threshold: NDArray[np.float64] = share * np.sqrt(squares / samples)
    return threshold


def moving(qd: NDArray[np.float64], threshold: NDArray[np.float64], decimation: Decimation) -> NDArray[np.bool_]:
    """Which equations have no slow sample within half a decimated period on either side, shape (M, n).

    Parameters
    ----------
    qd
        Velocities at all samples, shape (N, n).
    threshold
        Of :func:`velocity_threshold`, shape (n,).
    decimation
        Parallel filter of the equations.
    """
    slow = np.cumsum(np.abs(qd) < threshold, axis=0, dtype=np.int64)
    slow = np.concatenate([np.zeros((1, qd.shape[1]), dtype=np.int64), slow])
    kept, reach = decimation.instants(qd.shape[0]), decimation.factor // 2
    first, last = np.maximum(kept - reach, 0), np.minimum(kept + reach + 1, qd.shape[0])
    fast: NDArray[np.bool_] = slow[last] == slow[first]
    return fast
