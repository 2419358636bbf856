"""Smoothing of the sign of each joint's velocity (thesis appendix B.2), from the motion and then from the torques.

The width ``1/g`` of ``(2/pi) atan(g qd)`` is the velocity over which dry friction reverses. The torques determine it
where the joint reverses often enough; elsewhere it is a share of the joint's top speed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize
from scipy.special import chdtri

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.identification.equations import Prepared, tested
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.regression.ar_noise import WHITE, ArModel, fit_ar
from armident.identify.regression.orders import MAX_AR_ORDER
from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.bandwidth import position_noise
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import Streamed, chosen

SATURATION = 450.0
"""``g`` times the top speed of the joint, before the torques are used.

Source: 150 s/rad suffices for all joints of the TX40 (appendix B.2), so for the slowest one, of 3.1 rad/s (joint 5 of
`tx40_4.yaml`, 99 % quantile; all: 3.1 to 9.3 rad/s). The smoothed sign reaches 0.99 at 14 % of the top speed.
"""

TOP_QUANTILE = 0.99
"""Quantile of the absolute velocity that counts as the top speed."""

SPEEDS_PER_PERIOD = 8
"""Velocities per period of the low-pass from which the top speed of a long recording is taken: all of them would take
as much memory as the recording."""

LARGEST_CUTOFF = 0.45
"""Highest cut-off of the velocity filter, over the sampling rate."""

SHARPEST = 1e-4
"""Least width over the top speed: the sign then differs from a sharp one in one sample of 10 000 of a ramp."""

WIDTHS_PER_DECADE = 5
"""Widths tried in a decade, before the best one is refined: the likelihood of a width changes slowly with it."""

COVERAGE = 0.95
"""Coverage of the interval of a width."""

DEPENDENT = 1e-8
"""Singular values of a joint's equations, relative to the largest, that count as rounding errors."""


@dataclass(frozen=True)
class Speeds:
    """Top (99 % quantile) and rms velocity of each joint, and its noise by the encoder, (n,) each, rad/s or m/s."""

    top: Array
    rms: Array
    noise: Array


@dataclass(frozen=True)
class Transition:
    """Velocity over which dry friction of a joint reverses, and its 95 % interval, rad/s or m/s.

    ``low`` is zero where the encoder's noise hides how sharp the reversal is. ``saturating``: velocity of ``tanh``, if
    that law, which reaches the full friction sooner than ``atan``, explains the torques as well or better.
    """

    velocity: float
    low: float
    high: float
    saturating: float | None = None


def recorded_speeds(experiments: Sequence[Experiment], bandwidth_hz: float) -> Speeds:
    """Velocities of each joint, after a zero-phase low-pass at the closed-loop bandwidth."""
    speeds, noise, power, samples = [], [], np.zeros(experiments[0].q.shape[1]), 0
    for e in experiments:
        cutoff = min(bandwidth_hz, LARGEST_CUTOFF / e.dt)
        speed = np.abs(central_difference(butterworth(e.q, e.dt, cutoff), e.dt))
        power += np.sum(speed**2, axis=0)
        samples += speed.shape[0]
        every = max(1, int(1 / (SPEEDS_PER_PERIOD * cutoff * e.dt))) if isinstance(experiments, Streamed) else 1
        speeds.append(speed[::every].copy())
        # White noise has the density 2 var dt per Hz; differentiated up to the cut-off, its variance is this integral.
        noise.append(position_noise(e.q, e.dt) * np.sqrt(8 / 3 * e.dt * np.pi**2 * cutoff**3))
    top = [np.quantile(np.concatenate([s[:, j] for s in speeds]), TOP_QUANTILE) for j in range(speeds[0].shape[1])]
    return Speeds(np.array(top), np.sqrt(power / samples), np.max(noise, axis=0))


def with_sign_smoothing(robot: RobotConfig, speeds: Speeds) -> RobotConfig:
    """Return the configuration with a number for each joint's ``friction.sign_smoothing``, where it gives none.

    The width ``1/g`` is ``1 / SATURATION`` of the top speed, but not below the noise of the velocity.
    """
    width = np.maximum(speeds.top / SATURATION, speeds.noise)
    return with_numbers(
        robot,
        [_rounded(w) if w > 0 else float(given) for w, given in zip(width, robot.sign_smoothing, strict=True)],
    )


def _rounded(width: float) -> float:
    """``g`` of a width with four digits: the document shows the number that was used."""
    return float(f"{1 / width:.4g}")


def with_estimated_smoothing(
    given: RobotConfig, prepared: Prepared, decimation: Decimation, speeds: Speeds, criteria: IdentificationCriteria
) -> tuple[RobotConfig, dict[str, Transition]]:
    """Return the ``given`` configuration with the transitions that the torques determine, and these by joint.

    Profile likelihood of the width, joint by joint, with all other parameters of the joint's equations free.
    """
    found, numbers = {}, prepared.model.smoothing.copy()
    for j, joint in enumerate(given.joints):
        # Wider than this, the smoothed sign is no sign at the joint's usual speed: then it is another friction law.
        widest = speeds.rms[j] / np.tan(0.5 * np.pi * criteria.min_smoothed_sign)
        sharpest = max(float(speeds.noise[j]), SHARPEST * float(speeds.top[j]))
        transition = _transition(prepared, decimation, j, (sharpest, widest), criteria) if sharpest < widest else None
        if transition is not None:
            found[joint.name] = transition
            numbers[j] = _rounded(transition.velocity)
    return with_numbers(given, numbers), found


def _transition(
    prepared: Prepared, decimation: Decimation, j: int, limits: tuple[float, float], criteria: IdentificationCriteria
) -> Transition | None:
    """Transition of one joint; ``None`` if the torques do not determine it within its ``limits``, rad/s or m/s."""
    name = f"fc{j + 1}"
    if name not in prepared.model.base.names:
        return None
    count = max(3, round(WIDTHS_PER_DECADE * np.log10(limits[1] / limits[0])))
    logs = np.linspace(np.log(limits[0]), np.log(limits[1]), count)
    profile = _Profile(prepared, decimation, j, prepared.model.base.names.index(name))
    best = min(logs, key=profile.misfit)
    # The likelihood of the serial correlation of what the best width leaves.
    profile = _Profile(prepared, decimation, j, profile.column, fit_ar(profile.residual(best), MAX_AR_ORDER))
    best, least = profile.lowest(logs)
    clear = float(chdtri(1, criteria.false_alarm_rate / prepared.model.n))

    def above(log: float, margin: float = float(chdtri(1, 1.0 - COVERAGE))) -> float:
        return float(profile.rows * np.log(profile.misfit(log) / least) - margin)

    if above(float(np.log(1 / prepared.model.smoothing[j])), clear) <= 0 or above(logs[-1]) <= 0:
        return None
    low = np.exp(optimize.brentq(above, logs[0], best)) if above(logs[0]) > 0 else 0.0
    high = np.exp(optimize.brentq(above, best, logs[-1]))
    profile.law = np.tanh
    other, misfit = profile.lowest(logs)
    as_good = profile.rows * np.log(misfit / least) <= clear
    return Transition(float(np.exp(best)), float(low), float(high), float(np.exp(other)) if as_good else None)


def law_error(prepared: Prepared, decimation: Decimation, transitions: Mapping[str, Transition]) -> Array | None:
    """Change of the parameters (b,), SI, by the law that saturates sooner, for joints whose torques allow that law.

    The law of the transition is not known there: its effect on the parameters is a systematic uncertainty
    (JCGM 100:2008, 4.3). ``None``: the torques of all joints prefer the law of the model.
    """
    blocks, names = prepared.equations(decimation), prepared.model.base.names
    numbers = tested(blocks)
    joints = [joint.name for joint in prepared.model.robot.joints]
    columns = {joints.index(name): one.saturating for name, one in transitions.items() if one.saturating is not None}
    if not columns:
        return None
    own, other = [blocks[k] for k in numbers], []
    for block, signals in zip(own, chosen(prepared.signals, numbers), strict=True):
        x = block.x.copy()
        for j, velocity in columns.items():
            x[:, j, names.index(f"fc{j + 1}")] = decimation(np.tanh(signals.qd[:, j] / velocity))
        other.append(replace(block, x=x))
    one, two = (idim_ls(each, names).theta for each in (own, other))
    return np.asarray(two - one)


def atan_sign(x: Array) -> Array:
    """Smoothed sign of the model (thesis appendix B.2)."""
    return np.asarray(2 / np.pi * np.arctan(x))


class _Profile:
    """Sum of squares of joint j's equations over the width of its smoothed sign, the other parameters free."""

    def __init__(self, prepared: Prepared, used: Decimation, j: int, column: int, noise: ArModel = WHITE) -> None:
        every = prepared.equations(used)
        numbers = tested(every)
        blocks = [every[k] for k in numbers]
        self.column, self._noise, self._decimation = column, noise, used
        self.law: Callable[[Array], Array] = atan_sign
        self._velocities = [s.qd[:, j, None] for s in chosen(prepared.signals, numbers)]
        self._keep = [block.keep[noise.order :, j] for block in blocks]
        x = self._whitened([np.delete(block.x[:, j], column, axis=1) for block in blocks])
        scale = np.linalg.norm(x, axis=0)
        left, values, _ = np.linalg.svd(x[:, scale > 0] / scale[scale > 0], full_matrices=False)
        self._others = left[:, values > DEPENDENT * values[0]]
        self._torque = self._free(self._whitened([block.y[:, j, None] for block in blocks])[:, 0])
        self.rows = int(self._torque.size)

    def lowest(self, logs: Array) -> tuple[float, float]:
        """Logarithm of the width with the least sum of squares, and this sum; ``logs``: of the widths tried."""
        k = int(np.argmin([self.misfit(log) for log in logs]))
        inner = logs[max(k - 1, 0)], logs[min(k + 1, logs.size - 1)]
        found = optimize.minimize_scalar(self.misfit, bounds=inner, method="bounded")
        return float(found.x), float(found.fun)

    def misfit(self, log_width: float) -> float:
        """Sum of squares with a width, whose logarithm is given."""
        rest = self._rest(log_width)
        return float(rest @ rest)

    def residual(self, log_width: float) -> list[Array]:
        """Residual of the equations with a width, (M,) for each experiment."""
        sizes = np.cumsum([int(keep.sum()) for keep in self._keep])[:-1]
        return np.split(self._rest(log_width), sizes)

    def _rest(self, log_width: float) -> Array:
        width = np.exp(log_width)
        signs = [self._decimation(self.law(velocity / width)) for velocity in self._velocities]
        sign = self._free(self._whitened(signs)[:, 0])
        return np.asarray(self._torque - sign * (sign @ self._torque) / (sign @ sign))

    def _free(self, column: Array) -> Array:
        return np.asarray(column - self._others @ (self._others.T @ column))

    def _whitened(self, series: Sequence[Array]) -> Array:
        return np.concatenate([self._noise.whiten(x)[keep] for x, keep in zip(series, self._keep, strict=True)])


def with_numbers(robot: RobotConfig, smoothing: Sequence[float] | Array) -> RobotConfig:
    """Configuration with numbers ``g`` (n,), s/rad or s/m, for ``friction.sign_smoothing`` where it gives none."""
    if robot.friction.sign_smoothing is not None:
        return robot
    numbers = tuple(float(g) for g in smoothing)
    return robot.model_copy(update={"friction": robot.friction.model_copy(update={"sign_smoothing": numbers})})


def unsaturated_joints(given: RobotConfig, robot: RobotConfig, speeds: Speeds) -> list[str]:
    """Warnings for joints so slow that the smoothing of the sign biases their friction; ``given``: by the user."""
    reached = 2 / np.pi * np.arctan(robot.sign_smoothing * speeds.rms)
    warnings = []
    for j, joint in enumerate(robot.joints):
        if reached[j] >= IdentificationCriteria.min_smoothed_sign or speeds.rms[j] == 0.0:
            continue
        unit = "s/rad" if joint.type == "revolute" else "s/m"
        wanted = SATURATION / max(float(speeds.top[j]), 1e-300)
        change = given.friction.sign_smoothing is not None and speeds.top[j] / SATURATION > speeds.noise[j]
        remedy = (
            f"leave friction.sign_smoothing out, or set {wanted:.3g} {unit} for this joint"
            if change
            else "record faster motion of this joint"
        )
        warnings.append(
            f"{joint.name}: the smoothed sign (g = {robot.sign_smoothing[j]:.4g} {unit}) reaches only "
            f"{100 * reached[j]:.0f} % at the joint's rms velocity: Coulomb and viscous friction are biased. "
            f"Next: {remedy}."
        )
    return warnings
