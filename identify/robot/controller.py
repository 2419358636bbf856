"""Discrete joint controllers that the simulation runs once per sample."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from armident.arrays import Array


@dataclass(frozen=True, eq=False)
class DiscreteController:
    """One linear controller per motor, with saturation of the output ``nu``.

    ``nu(k) = sum_i error_taps[:, i] eps(k-i) + sum_i position_taps[:, i] q_motor(k-i)
    + sum_i output_taps[:, i] nu(k-1-i)`` with ``eps = R (q_ref - q)``, ``q_motor = R q`` and the transmission matrix R.
    Later samples use the limited ``nu``. Taps: (n, m), N m/rad or N/m, of outputs without unit; ``saturation``: (n,).
    """

    error_taps: Array
    position_taps: Array
    output_taps: Array
    saturation: Array
    dt: float

    def __post_init__(self) -> None:
        """Check shapes and values."""
        n = self.saturation.shape[0]
        for name in ("error_taps", "position_taps", "output_taps"):
            taps = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if taps.ndim != 2 or taps.shape[0] != n or not np.isfinite(taps).all():
                raise ValueError(f"{name}: expected finite numbers of shape ({n}, m), found {taps.shape}")
            object.__setattr__(self, name, taps)
        if self.saturation.shape != (n,) or not (self.saturation > 0.0).all() or not self.dt > 0.0:
            raise ValueError(
                f"expected positive saturation of shape (n,) and positive dt, found {self.saturation} and {self.dt}"
            )

    @property
    def n(self) -> int:
        """Number of motors."""
        return int(self.saturation.size)

    @property
    def memory(self) -> int:
        """Number of samples that the controller uses, the present one included."""
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

        ``kp``: 1/s. ``kv``: drive's signal per rad/s or m/s. ``gain``: motor torque per unit of the drive's signal.
        ``qd_motor`` is the difference over ``velocity_samples`` periods; 2: mean of the last two backward differences.
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
        """Controller of impulse responses (n, m) from the tracking error to the motor torque (CRC, thesis 5.2)."""
        taps = np.atleast_2d(np.asarray(taps, dtype=np.float64))
        empty = np.zeros((taps.shape[0], 0))
        return cls(taps, empty, empty, _limits(saturation, taps.shape[0]), dt)


def _limits(saturation: ArrayLike | None, n: int) -> Array:
    if saturation is None:
        return np.full(n, np.inf)
    return np.broadcast_to(np.asarray(saturation, dtype=np.float64), (n,)).copy()
