"""Order analysis: torque ripple at any real order of an angle, by a fast Fourier transform of bins of the angle."""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.identify.diagnosis.candidates import Shapes
from armident.identify.diagnosis.study import Study

OVERSAMPLING = 8
"""Bins per half period of the highest order; amplitudes there are attenuated by less than 1 %."""
PADDING = 4
"""Orders searched per independent order."""
NEIGHBOURS = 32
"""Independent orders from whose median the background is estimated."""
STANDSTILL = 0.02
"""Speed over the top speed of a motor below which it counts as standing."""
SLOW = 0.2
"""Quantile of the speeds at which the highest order reaches the band of the comparison."""
PEAKS = 3
"""Most orders returned."""


def strongest_orders(angle: Sequence[Array], residual: Sequence[Array], highest: float) -> list[tuple[float, float]]:
    """Return the `PEAKS` strongest orders, cycles per 2 pi of the angle, with power over the neighbourhood's median."""
    low = min(float(a.min()) for a in angle)
    span = max(float(a.max()) for a in angle) - low
    if span <= 0.0 or highest <= 0.0:
        return []
    bins = int(np.ceil(2 * OVERSAMPLING * highest * span / (2 * np.pi))) + 1
    width = span / bins
    size = 1 << int(np.ceil(np.log2(PADDING * bins)))
    power = np.zeros(size // 2 + 1)
    for a, e in zip(angle, residual, strict=True):
        number = np.minimum(((a - low) / width).astype(np.int64), bins - 1)
        power += np.abs(np.fft.rfft(np.bincount(number, e, minlength=bins), size)) ** 2
    orders = np.arange(power.size) * (2 * np.pi / (size * width))
    apart = 2 * np.pi / span
    inside = np.flatnonzero((orders >= 2 * apart) & (orders <= highest))
    if inside.size < 3:
        return []
    own = power[inside]
    reach = max(int(NEIGHBOURS * apart / (orders[1] - orders[0])), 3)
    found: list[tuple[float, float]] = []
    blocked = np.zeros(own.size, bool)
    for _ in range(PEAKS):
        k = int(np.argmax(np.where(blocked, 0.0, own)))
        if blocked[k]:
            break
        around = own[max(k - reach, 0) : k + reach + 1]
        found.append((float(orders[inside[k]]), float(own[k] / max(float(np.median(around)), 1e-300))))
        blocked |= np.abs(orders[inside] - orders[inside[k]]) < 1.5 * apart
    return found


def motor_orders(study: Study, theta: Array, motor: int) -> tuple[Shapes, ...]:
    """Return the orders of the strongest ripples of a residual over the angle of a motor, as a grid of an effect."""
    ratios = study.robot.transmission_matrix[motor]
    joint = int(np.argmax(np.abs(ratios)))
    residual = [study.residual(s, theta)[:, joint] for s in study.train]
    angles = [s.measured.q @ ratios for s in study.train]
    speed = np.concatenate([np.abs(s.measured.qd @ ratios) for s in study.train])
    moving = speed[speed > STANDSTILL * speed.max()]
    if not moving.size:
        return ()
    cutoff = 0.5 / (study.dt * study.decimation.factor)
    highest = 2 * np.pi * cutoff / float(np.quantile(moving, SLOW))
    apart = _resolution(study, motor)
    found = strongest_orders(angles, residual, highest)
    return tuple((("harmonic", order + k * apart / 4),) for order, _ in found for k in range(-2, 3))


def nearby_orders(study: Study, motor: int, order: float) -> tuple[Shapes, ...]:
    """Return orders (cycles per 2 pi of the motor's angle) close to one, at a sixteenth of the motion's resolution."""
    apart = _resolution(study, motor)
    return tuple((("harmonic", order + k * apart / 16),) for k in range(-3, 4))


def _resolution(study: Study, motor: int) -> float:
    """Difference of two orders that the motion tells apart, cycles per 2 pi of the angle of a motor."""
    ratios = study.robot.transmission_matrix[motor]
    return 2 * np.pi / max(float(np.ptp(np.concatenate([s.measured.q @ ratios for s in study.train]))), 1e-12)
