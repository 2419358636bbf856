"""Discrete joint controllers at the sample rate, as the simulation runs them."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from armident.identify.robot.chain import Floats


@dataclass(frozen=True, eq=False)
class DiscreteController:
    """One linear controller per motor, with saturation.

    ``nu(k) = sum_i error_taps[:, i] eps(k-i) + sum_i position_taps[:, i] q_motor(k-i)
    + sum_i output_taps[:, i] nu(k-1-i)``, ``eps = R (q_ref - q)``, then limited to ``saturation``; the
    limited value is what later samples see.

    Parameters
    ----------
    error_taps, position_taps, output_taps
        Shapes (n, m), (n, m2), (n, m3); motor torque (N m or N) per rad or m, and per unit of itself.
    saturation
        Largest absolute motor torque, shape (n,); ``inf`` where there is no limit.
    dt
        Sampling period, s.

    Raises
    ------
    ValueError
        If the shapes do not fit together or a number is not finite.
    """

    error_taps: Floats
    position_taps: Floats
    output_taps: Floats
    saturation: Floats
    dt: float

    def __post_init__(self) -> None:
        """Check the shapes."""
        n = self.saturation.shape[0]
        for name in ("error_taps", "position_taps", "output_taps"):
            taps = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if taps.ndim != 2 or taps.shape[0] != n or not np.isfinite(taps).all():
                raise ValueError(f"{name}: expected finite numbers of shape ({n}, m), found {taps.shape}")
            object.__setattr__(self, name, taps)
        if self.saturation.shape != (n,) or not (self.saturation > 0.0).all() or not self.dt > 0.0:
            raise ValueError("saturation (n,) and dt must be positive")

    @property
    def n(self) -> int:
        """Number of motors."""
        return int(self.saturation.size)

    @property
    def memory(self) -> int:
        """How many samples back the controller looks, the present one included."""
        widths = (self.error_taps.shape[1], self.position_taps.shape[1], self.output_taps.shape[1] + 1)
        return max(int(width) for width in widths)

    @classmethod
    def cascade(
        cls,
        kp: ArrayLike,
        kv: ArrayLike,
        gain: ArrayLike,
        dt: float,
        saturation: ArrayLike | None = None,
        velocity_samples: int = 1,
    ) -> Self:
        """Position loop around a velocity loop: ``nu = gain kv (kp eps - qd_motor)`` (thesis section B.3).

        The velocity is the difference of the motor position over ``velocity_samples`` periods.

        Parameters
        ----------
        kp
            (n,), 1/s.
        kv
            (n,), units of the drive's signal per rad/s or m/s of the motor.
        gain
            (n,), motor torque or force per unit of the drive's signal.
        velocity_samples
            At least 1; 2 is the mean of the last two backward differences.

        Raises
        ------
        ValueError
            If ``velocity_samples`` is not positive.
        """
        if velocity_samples < 1:
            raise ValueError(f"velocity_samples: expected at least 1, got {velocity_samples}")
        kp, kv, gain = np.broadcast_arrays(
            *(np.atleast_1d(np.asarray(value, dtype=np.float64)) for value in (kp, kv, gain))
        )
        loop = gain * kv
        position = np.zeros((loop.size, velocity_samples + 1))
        position[:, 0] = -loop / (velocity_samples * dt)
        position[:, -1] = loop / (velocity_samples * dt)
        return cls(
            error_taps=(loop * kp)[:, None],
            position_taps=position,
            output_taps=np.zeros((loop.size, 0)),
            saturation=_limits(saturation, loop.size),
            dt=dt,
        )

    @classmethod
    def fir(cls, taps: ArrayLike, dt: float, saturation: ArrayLike | None = None) -> Self:
        """Finite impulse responses from the tracking error to the motor torque, ``taps`` (n, m) (5.2, CRC)."""
        taps = np.atleast_2d(np.asarray(taps, dtype=np.float64))
        empty = np.zeros((taps.shape[0], 0))
        return cls(taps, empty, empty, _limits(saturation, taps.shape[0]), dt)


def _limits(saturation: ArrayLike | None, n: int) -> Floats:
    if saturation is None:
        return np.full(n, np.inf)
    return np.broadcast_to(np.asarray(saturation, dtype=np.float64), (n,)).copy()
