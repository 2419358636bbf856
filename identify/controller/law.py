"""Control law of a drive: structure, regression columns, taps of the discrete controller, and gains.

Motor side, at the drive's sample rate, with ``e = q_r - q``::

    nu = kv (kp e - v) + feed-forward of the reference's velocity and acceleration + integral of the velocity loop

where ``v`` is the difference of measured positions, possibly over several samples and through a first-order filter.
A drive on the tracking error, ``kv (kp e + de/dt)``, is the same law with all of the reference's velocity fed forward.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armident.arrays import Array
from armident.identify.signals.recursive import recursive_filter


@dataclass(frozen=True)
class Structure:
    """Structure of the control law of one drive.

    ``velocity``, input of the velocity gain: ``position``: the measured velocity (a cascade); ``error``: derivative of
    the tracking error (a PD, or full velocity feed-forward); ``both``: that of the reference has a gain of its own.
    ``velocity_taps``: number of backward differences in it, each with a weight. ``filtered``: low-pass on ``velocity``,
    on the whole ``command``, or none. ``acceleration``: that of the reference is fed forward. ``delay``: whole samples.
    ``added``: the record contains a known torque of other origin; its share is estimated.
    """

    velocity: Literal["position", "error", "both"] = "position"
    velocity_taps: int = 1
    filtered: Literal["velocity", "command"] | None = None
    integral: bool = False
    acceleration: bool = False
    delay: int = 0
    added: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the linear parameters in their order: those whose inputs are not filtered come first."""
        lags = range(self.velocity_taps)
        return (
            *(("added",) if self.added else ()),
            "e",
            *(("integral",) if self.integral else ()),
            *(("acceleration",) if self.acceleration else ()),
            *(f"v{i}" for i in lags),
            *((f"r{i}" for i in lags) if self.velocity == "both" else ()),
        )

    @property
    def unfiltered(self) -> int:
        """Number of linear parameters whose inputs are not filtered."""
        if self.filtered is None:
            return len(self.names)
        if self.filtered == "command":
            return int(self.added)
        return self.added + 1 + self.integral + self.acceleration

    @property
    def size(self) -> int:
        """Number of parameters: the linear ones and, last, the pole of the filter."""
        return len(self.names) + (self.filtered is not None)

    @property
    def lead(self) -> int:
        """Number of samples at the start of a stretch that serve only as past values."""
        return self.delay + self.velocity_taps + 1

    def pole(self, theta: Array) -> float:
        """Return the pole of the filter; 0 without one."""
        return float(theta[-1]) if self.filtered else 0.0

    def __str__(self) -> str:
        """Return a description of the structure in one line."""
        form = {"position": "cascade", "error": "PD on the error", "both": "cascade with velocity feed-forward"}
        parts = [form[self.velocity]]
        if self.integral:
            parts.append("integral velocity loop")
        if self.velocity_taps > 1:
            parts.append(f"velocity over {self.velocity_taps} samples")
        if self.filtered:
            parts.append(f"filtered {self.filtered}")
        if self.acceleration:
            parts.append("acceleration feed-forward")
        if self.delay:
            parts.append(f"{self.delay} samples late")
        return ", ".join(parts)


@dataclass(frozen=True)
class Stretch:
    """Samples (N,) of a motor without gaps: ``q``, ``r``, torque ``nu``; ``added``: known part of other origin."""

    q: Array
    r: Array
    nu: Array
    added: Array

    def part(self, span: slice) -> "Stretch":
        """Return the samples of a slice."""
        return Stretch(self.q[span], self.r[span], self.nu[span], self.added[span])


def loop_ratios(structure: Structure, theta: Array) -> tuple[float, float]:
    """Position gain ``kp`` (1/s) and share of the reference's velocity fed forward; zeros before the first fit."""
    value = _levels(structure, theta)
    kv = sum(value[f"v{i}"] for i in range(structure.velocity_taps))
    if kv == 0.0:
        return 0.0, 0.0
    if structure.velocity != "both":
        return value["e"] / kv, float(structure.velocity == "error")
    return value["e"] / kv, sum(value[f"r{i}"] for i in range(structure.velocity_taps)) / kv


def columns(stretch: Stretch, structure: Structure, theta: Array, dt: float) -> Array:
    """Inputs of the law (N - lead, m) in the order of its names; the integral's contains the `loop_ratios`."""
    e = stretch.r - stretch.q
    v, speed = (np.diff(x, prepend=x[0]) / dt for x in (stretch.q, stretch.r))
    velocity = speed - v if structure.velocity == "error" else -v
    inputs = {"e": e, "acceleration": np.diff(speed, prepend=speed[0]) / dt}
    if structure.integral:
        kp, forward = loop_ratios(structure, theta)
        inputs["integral"] = dt * np.cumsum(kp * e - v + forward * speed)
    for i in range(structure.velocity_taps):
        inputs[f"v{i}"], inputs[f"r{i}"] = _late(velocity, i), _late(speed, i)
    inputs = {name: _late(x, structure.delay) for name, x in inputs.items()} | {"added": stretch.added}
    return np.stack([inputs[name][structure.lead :] for name in structure.names], axis=1)


def integral_slopes(stretch: Stretch, structure: Structure, theta: Array, dt: float) -> Array:
    """Derivatives of the torque by the gains inside the integral's input (N - lead, m), for a Gauss-Newton step.

    The sum with `columns` is the Jacobian; these slopes times ``theta`` are zero: a regression on the sum suffices.
    """
    names, past = structure.names, 1.0 / (1.0 - structure.pole(theta))
    level = {name: 1.0 if i < structure.unfiltered else past for i, name in enumerate(names)}
    kp, forward = loop_ratios(structure, theta)
    kv = sum(level["v0"] * theta[names.index(f"v{i}")] for i in range(structure.velocity_taps))
    share = theta[names.index("integral")] / kv if kv != 0.0 else 0.0
    error, reference = dt * np.cumsum(stretch.r - stretch.q), stretch.r - stretch.r[0]
    inside = {
        "e": error,
        "v": -kp * error - (forward * reference if structure.velocity == "both" else 0.0),
        "r": reference,
    }
    slopes = np.zeros((stretch.q.size - structure.lead, len(names)))
    for i, name in enumerate(names):
        if name[0] in inside:
            slopes[:, i] = share * level[name] * _late(inside[name[0]], structure.delay)[structure.lead :]
    return pole_filter(slopes, structure.pole(theta)) if structure.filtered == "command" else slopes


def simulate_law(stretch: Stretch, structure: Structure, theta: Array, dt: float) -> Array:
    """Torque of the law (N - lead,), N m or N, along measured motion; the initial integral is that of the best fit."""
    m, split = len(structure.names), structure.unfiltered
    u = columns(stretch, structure, theta, dt)
    simulated: Array = u[:, :split] @ theta[:split] + pole_filter(u[:, split:] @ theta[split:m], structure.pole(theta))
    if structure.integral:
        simulated = simulated + np.mean(stretch.nu[structure.lead :] - simulated)
    return simulated


def pole_filter(x: Array, pole: float) -> Array:
    """``x / (1 - pole z^-1)`` along the first axis, from the steady state of its first sample."""
    if pole == 0.0 or x.size == 0:
        return x
    return np.asarray(recursive_filter([1.0], [1.0, -pole], x - x[0]) + x[0] / (1.0 - pole))


def taps(structure: Structure, theta: Array, dt: float) -> tuple[Array, Array, Array]:
    """Taps on tracking error and motor position, N m/rad or N/m, and on past outputs, from one period ago."""
    pole = structure.pole(theta)
    kp, forward = loop_ratios(structure, theta)
    integrate = np.array([1.0, -1.0]) if structure.integral else np.ones(1)
    difference = np.array([1.0, -1.0]) / dt
    error, position = np.zeros(structure.lead + 6), np.zeros(structure.lead + 6)
    for index, (name, value) in enumerate(zip(structure.names, theta[: len(structure.names)], strict=True)):
        ahead = np.array([1.0, -pole]) if index < structure.unfiltered else np.ones(1)
        lag = structure.delay + (int(name[1:]) if name[0] in "vr" else 0)
        on_velocity = value * np.convolve(np.convolve(ahead, integrate), difference)
        if name == "e":
            _add(error, value * np.convolve(ahead, integrate), lag)
        elif name == "integral":
            _add(error, value * dt * (kp * ahead), lag)
            _add(error, value * dt * forward * np.convolve(ahead, difference), lag)
            _add(position, value * dt * (forward - 1.0) * np.convolve(ahead, difference), lag)
        elif name == "acceleration":
            _add(error, np.convolve(on_velocity, difference), lag)
            _add(position, np.convolve(on_velocity, difference), lag)
        elif name[0] == "v" and structure.velocity == "error":
            _add(error, on_velocity, lag)
        elif name[0] == "v":
            _add(position, -on_velocity, lag)
        elif name[0] == "r":
            _add(error, on_velocity, lag)
            _add(position, on_velocity, lag)
    denominator = np.convolve(np.array([1.0, -pole]), integrate) if structure.filtered else integrate
    return _trimmed(error), _trimmed(position), -denominator[1:]


UNITS = {
    "kp": "1/s",
    "kv": "drive unit per motor speed",
    "stiffness": "drive unit per motor position",
    "error_delay": "samples",
    "velocity_delay": "samples",
    "ti": "s",
    "velocity_feedforward": "1",
    "acceleration_feedforward": "drive unit per motor acceleration",
    "corner": "Hz",
    "added": "1",
}
"""Units of the gains; motor positions, speeds and accelerations are in rad or m and s."""


def gains(structure: Structure, theta: Array, dt: float, unit: float) -> dict[str, float]:
    """Gains of the law by the names of a drive's data sheet, in the units of `UNITS`.

    ``unit``: motor torque per unit of the drive's signal. ``stiffness`` is ``kp kv``. Delays are the mean age of the
    inputs; a backward difference is half a sample old.
    """
    value, pole = _levels(structure, theta), structure.pole(theta)
    lags = range(structure.velocity_taps)
    kv = sum(value[f"v{i}"] for i in lags)
    late = pole / (1.0 - pole)
    found = {
        "kp": value["e"] / kv,
        "kv": kv / unit,
        "stiffness": value["e"] / unit,
        "error_delay": structure.delay + (late if structure.filtered == "command" else 0.0),
        "velocity_delay": structure.delay + 0.5 + sum(i * value[f"v{i}"] for i in lags) / kv + late,
    }
    if structure.integral:
        found["ti"] = kv / value["integral"]
    if structure.velocity == "both":
        found["velocity_feedforward"] = sum(value[f"r{i}"] for i in lags) / kv
    if structure.acceleration:
        found["acceleration_feedforward"] = value["acceleration"] / unit
    if structure.filtered and pole > 0:
        found["corner"] = float(-np.log(pole) / (2 * np.pi * dt))
    if structure.added:
        found["added"] = value["added"]
    return found


def _levels(structure: Structure, theta: Array) -> dict[str, float]:
    """Steady-state gain of every input."""
    past = 1.0 / (1.0 - structure.pole(theta))
    return {
        name: float(theta[i]) * (1.0 if i < structure.unfiltered else past) for i, name in enumerate(structure.names)
    }


def _late(x: Array, samples: int) -> Array:
    return np.concatenate([np.full(samples, x[0]), x[: x.size - samples]])


def _add(values: Array, addition: Array, lag: int) -> None:
    values[lag : lag + addition.size] += addition


def _trimmed(values: Array) -> Array:
    used = np.flatnonzero(values)
    return values[: used[-1] + 1] if used.size else np.empty(0)
