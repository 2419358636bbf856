"""Residuals as the position noise that the controller has turned into torque (thesis equations 6.17 and 6.28)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.regression.ar_noise import ArModel, fit_spectrum
from armident.identify.regression.equations import ExperimentEquations
from armident.identify.robot.controller import DiscreteController
from armident.identify.signals.recursive import recursive_filter

FREQUENCIES = 2048
"""Points of the controller's frequency response, zero to the Nyquist frequency of the decimated equations."""

SMALLEST_GAIN = 1e-4
"""Floor of the controller's gain as a share of its largest: a pure velocity loop has none at zero frequency."""


@dataclass(frozen=True)
class InverseController:
    """Turns joint torque equations into equations of motor positions, ``C_j^-1`` applied to every term (6.28).

    Noise models describe spectra only. So ``C_j^-1`` is the stable, causal filter with the controller's inverse gain at
    every frequency that the decimated equations hold: ``1 / D_j(z^-1)``, scaled. ``to_motor`` (n, n): inverse of the
    transmission. ``shapes``: one ``D_j`` and its scale for each motor.
    """

    to_motor: Array
    shapes: tuple[ArModel, ...]

    @classmethod
    def of(cls, auxiliary: AuxiliaryModel, order: int) -> Self:
        """Inverse of the controller of a loop at its decimated rate; ``order``: highest of ``D_j``."""
        gain = controller_gain(auxiliary.controller, auxiliary.decimation.factor)
        inverse = np.asarray(np.linalg.inv(auxiliary.model.robot.transmission_matrix), dtype=np.float64)
        return cls(inverse, tuple(fit_spectrum(1.0 / row**2, order) for row in gain))

    def __call__(self, blocks: Sequence[ExperimentEquations]) -> list[ExperimentEquations]:
        """The same equations, torques (M, n) and regressor (M, n, b), at the motors and through ``C_j^-1``.

        An equation of a motor is kept where those of all joints that load it are.
        """
        return [
            ExperimentEquations(
                self._filtered(block.y @ self.to_motor),
                self._filtered(np.einsum("mjb,ji->mib", block.x, self.to_motor, optimize=True)),
                ~((~block.keep).astype(float) @ np.abs(self.to_motor) > 0.0),
                block.t,
            )
            for block in blocks
        ]

    def _filtered(self, values: Array) -> Array:
        out = np.empty_like(values)
        for j, shape in enumerate(self.shapes):
            recursion = np.append(1.0, shape.coefficients)
            out[:, j] = recursive_filter([np.sqrt(shape.variance)], recursion, values[:, j])
        return out


def controller_gain(controller: DiscreteController, factor: int) -> Array:
    """Gain (n, K) of each motor's controller from position noise to torque, up to the decimated Nyquist frequency.

    Position noise enters with the tracking error and, in a velocity loop, with the position itself.
    """
    z = np.exp(-1j * np.pi * np.linspace(0.0, 1.0, FREQUENCIES) / factor)

    def response(taps: Array) -> NDArray[np.complex128]:
        total: NDArray[np.complex128] = taps @ z[None, :] ** np.arange(taps.shape[1])[:, None]
        return total

    forward = response(controller.error_taps) - response(controller.position_taps)
    gain = np.abs(forward / (1.0 - z * response(controller.output_taps)))
    floored: Array = np.maximum(gain, SMALLEST_GAIN * gain.max(axis=1, keepdims=True))
    return floored
