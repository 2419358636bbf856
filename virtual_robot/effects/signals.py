"""Hidden errors of encoders, amplifiers, wiring and signal names between plant, drives and bus."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.compiled import PLAIN, compiled
from armident.configs import RobotConfig
from armident.virtual_robot.effects.forces import waves
from armident.virtual_robot.effects.spec import (
    AUTO,
    PER_TURN,
    PHASE,
    PITCH,
    EffectSpec,
    Hidden,
    ParameterSpec,
    flag,
    positive,
)

EFFECTS: dict[str, EffectSpec] = {
    "drive_gain_error": EffectSpec(
        "drive",
        "true torque per unit of the drive's signal differs from the configured one",
        {"error": ParameterSpec("-", "true gain over configured gain, minus 1", None, -0.9, 5.0)},
    ),
    "drive_gain_saturation": EffectSpec(
        "drive",
        "torque less than proportional to the signal by magnetic saturation: i / sqrt(1 + (i / i_s)^2)",
        {
            "drop": positive("-", "share of the torque lost at ``torque``", None, 0.9),
            "torque": positive("N m", "torque of that loss; half of the joint's limit unless given", AUTO),
        },
    ),
    "sign_error": EffectSpec(
        "report",
        "a signal of the drive is recorded with the wrong sign",
        {"torque": flag("1: the torque signal", 1.0), "position": flag("1: the position and the demand", 0.0)},
    ),
    "joint_order": EffectSpec(
        "report",
        "signals of two drives are exchanged in the recording",
        {"torque": flag("1: the torque signals", 1.0), "position": flag("1: the positions and the demands", 1.0)},
        other="required",
    ),
    "time_delay": EffectSpec(
        "report",
        "the torque signal is reported late",
        {"delay": ParameterSpec("s", "delay, whole samples or not", None, 0.0, 1.0)},
    ),
    "encoder_eccentricity": EffectSpec(
        "report",
        "periodic error of the measured position, which the drive follows",
        {
            "amplitude": ParameterSpec("rad", "amplitude, joint side"),
            "per_turn": PER_TURN,
            "phase": PHASE,
            "motor": flag("1: turns of the motor; 0: of the joint, metres of a prismatic one", 0.0),
            "pitch": PITCH,
        },
        repeatable=True,
    ),
    "actuator_bandwidth": EffectSpec(
        "drive",
        "first-order lag between the torque reported and the torque applied",
        {"time_constant": positive("s", "time constant", None, 1.0)},
    ),
    "mains_ripple": EffectSpec(
        "report",
        "interference of the mains frequency in the torque signal",
        {
            "amplitude": ParameterSpec("N m", "amplitude, joint side"),
            "frequency": positive("Hz", "frequency", 50.0),
            "phase": PHASE,
        },
        group="outside",
        repeatable=True,
    ),
    "current_crosstalk": EffectSpec(
        "report",
        "the torque signal contains a share of another drive's",
        {"share": ParameterSpec("-", "joint torque read per joint torque of the other", None, -1.0, 1.0)},
        other="required",
        group="outside",
    ),
}
"""Effects of this module."""


@compiled("f8[::1], f8[:, ::1], f8[:, ::1]", **PLAIN)
def _measured(q, encoders, to_joints):  # type: ignore[no-untyped-def]
    """Joint positions (n,) with encoder errors; rows of joint, amplitude, phase and wave numbers (n,)."""
    n = q.size
    error, out = np.zeros(n), q.copy()
    for e in range(encoders.shape[0]):
        angle = encoders[e, 2]
        for j in range(n):
            angle += encoders[e, 3 + j] * q[j]
        error[int(encoders[e, 0])] += encoders[e, 1] * math.sin(angle)
    for i in range(n):
        for j in range(n):
            out[i] += to_joints[i, j] * error[j]
    return out


@compiled("f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, f8[:, ::1]", **PLAIN)
def _applied(signal, level, knee, lag, lagging, period, torque):  # type: ignore[no-untyped-def]
    """Joint torques (n,) of signals (n,); ``lagging`` is advanced in place."""
    n = signal.size
    given, out = np.empty(n), np.zeros(n)
    for j in range(n):
        mean = signal[j]
        if lag[j] > 0.0:
            # Mean of the exponential over the period, constant in the plant.
            left = math.exp(-period / lag[j])
            away = lagging[j] - signal[j]
            mean = signal[j] + away * lag[j] / period * (1.0 - left)
            lagging[j] = signal[j] + away * left
        given[j] = level[j] * mean / math.sqrt(1.0 + (mean / knee[j]) ** 2)
    for i in range(n):
        for j in range(n):
            out[i] += torque[i, j] * given[j]
    return out


@compiled("f8[::1], f8[:, ::1], i8, f8[::1], f8[:, ::1], f8[:, ::1], f8", **PLAIN)
def _reported(signal, past, newest, delay, leak, ripples, t):  # type: ignore[no-untyped-def]
    """Signals (n,) as reported at ``t``; row ``newest`` of the ring ``past`` (L, n) receives the present ones.

    Ripples are rows of drive, amplitude, angular frequency and phase.
    """
    n, length = signal.size, past.shape[0]
    late, out = np.empty(n), np.zeros(n)
    for j in range(n):
        past[newest, j] = signal[j]  # as a loop; the message for an assignment of unequal shapes takes 3 s to compile
    for j in range(n):
        whole = int(delay[j])
        part = delay[j] - whole
        # Row k back from the newest.
        late[j] = (1.0 - part) * past[(newest + whole) % length, j] + part * past[(newest + whole + 1) % length, j]
    for i in range(n):
        for j in range(n):
            out[i] += leak[i, j] * late[j]
    for r in range(ripples.shape[0]):
        out[int(ripples[r, 0])] += ripples[r, 1] * math.sin(ripples[r, 2] * t + ripples[r, 3])
    return out


@compiled("f8[::1], f8[::1], f8[::1], i2[::1]", **PLAIN)
def _permille(signal, noise, permille, out):  # type: ignore[no-untyped-def]
    """Write signals (n,) with noise as numbers of the bus, int16, to ``out`` (n,)."""
    for j in range(signal.size):
        raw = math.floor((signal[j] + noise[j]) * permille[j] + 0.5)
        out[j] = np.int16(min(max(raw, -32768.0), 32767.0))


@compiled("i2[::1], i8[::1], i8[::1], i8, i8, i2[::1]", "i4[::1], i8[::1], i8[::1], i8, i8, i4[::1]", **PLAIN)
def _rewired(own, origin, sign, low, high, out):  # type: ignore[no-untyped-def]
    """Write numbers (n,) of permuted drives with changed signs, limited to the bus's range, to ``out`` (n,)."""
    for j in range(own.size):
        out[j] = min(max(sign[j] * np.int64(own[origin[j]]), low), high)


class Signals:
    """Hidden errors of positions and signals in each control period; ``swapped``: another name or sign is recorded."""

    def __init__(self, hidden: Sequence[Hidden], robot: RobotConfig, period: float) -> None:
        mine = [h for h in hidden if h.target in ("drive", "report")]
        self.acts = bool(mine)
        self.swapped = any(h.effect in ("sign_error", "joint_order") for h in mine)
        n, ratio = robot.n, robot.transmission_matrix
        self._period, self._periods = period, 0
        gain = np.array([joint.drive.gain for joint in robot.joints])
        joint_gain = gain * np.diag(ratio)

        encoders = [_encoder(h, robot) for h in mine if h.effect == "encoder_eccentricity"]
        self._encoders = np.array(encoders).reshape(len(encoders), 3 + n)
        self._to_joints = np.linalg.inv(ratio) * np.diag(ratio)

        self._torque = np.ascontiguousarray(ratio.T * gain)
        self._level, self._knee, self._lag = np.ones(n), np.full(n, np.inf), np.zeros(n)
        self._lagging = np.zeros(n)
        for h in mine:
            if h.effect == "drive_gain_error":
                self._level[h.joint] += h["error"]
            elif h.effect == "drive_gain_saturation":
                torque = h.value_or("torque", 0.5 * robot.joints[h.joint].limits.torque)
                signal = abs(torque / joint_gain[h.joint])
                self._knee[h.joint] = signal / math.sqrt((1.0 - h["drop"]) ** -2 - 1.0)
            elif h.effect == "actuator_bandwidth":
                self._lag[h.joint] = h["time_constant"]

        self._delay = np.zeros(n)
        self._leak = np.eye(n)
        ripples: list[tuple[float, float, float, float]] = []
        for h in mine:
            if h.effect == "time_delay":
                self._delay[h.joint] = h["delay"] / period
            elif h.effect == "current_crosstalk":
                self._leak[h.joint, h.other] += h["share"] * joint_gain[h.other] / joint_gain[h.joint]
            elif h.effect == "mains_ripple":
                amplitude = h["amplitude"] / joint_gain[h.joint]
                ripples.append((h.joint, amplitude, 2.0 * math.pi * h["frequency"], h["phase"]))
        self._ripples = np.array(ripples).reshape(-1, 4)
        self._past = np.zeros((int(self._delay.max()) + 2, n))

        self.torque_from, self.torque_sign = np.arange(n), np.ones(n, np.int64)
        self.position_from, self.position_sign = np.arange(n), np.ones(n, np.int64)
        for h in mine:
            if h.effect == "sign_error":
                self.torque_sign[h.joint] *= -1 if h["torque"] > 0.5 else 1
                self.position_sign[h.joint] *= -1 if h["position"] > 0.5 else 1
            elif h.effect == "joint_order":
                both, turned = [h.joint, h.other], [h.other, h.joint]
                for name, origin, sign in (
                    ("torque", self.torque_from, self.torque_sign),
                    ("position", self.position_from, self.position_sign),
                ):
                    if h[name] > 0.5:
                        origin[both], sign[both] = origin[turned], sign[turned]

    def measured(self, q: Array) -> Array:
        """Joint positions as measured by the encoders, shape (n,). ``q``: joint positions, rad or m, shape (n,)."""
        if not len(self._encoders):
            return q
        out: Array = _measured(q, self._encoders, self._to_joints)
        return out

    def applied(self, signal: Array) -> Array:
        """Joint torques (n,) of the motors over the next period, N m or N, from signals (n,), A, V or N m."""
        out: Array = _applied(signal, self._level, self._knee, self._lag, self._lagging, self._period, self._torque)
        return out

    def reported(self, signal: Array) -> Array:
        """Signals (n,), A, V or N m, as reported now, without noise, in the drives' own order."""
        newest = -self._periods % len(self._past)
        out: Array = _reported(
            signal, self._past, newest, self._delay, self._leak, self._ripples, self._periods * self._period
        )
        self._periods += 1
        return out

    def on_the_bus(self, signal: Array, noise: Array, permille: Array, out: NDArray[np.int16]) -> None:
        """Write the reported signals (n,) with noise as int16 numbers of the bus; ``permille``: numbers per unit."""
        _permille(self.reported(signal), noise, permille, out)

    def rewired_torque(self, own: NDArray[np.int16], out: NDArray[np.int16]) -> None:
        """Write torque signals (n,), in the drives' order, under the names and signs of the recording."""
        _rewired(own, self.torque_from, self.torque_sign, -32768, 32767, out)

    def rewired_position(self, own: NDArray[np.int32], out: NDArray[np.int32]) -> None:
        """Write positions or demands (n,), counts, under the names and signs of the recording."""
        _rewired(own, self.position_from, self.position_sign, -(2**31), 2**31 - 1, out)


def _encoder(h: Hidden, robot: RobotConfig) -> Array:
    """Row of an encoder error: joint, amplitude, phase, and wave numbers over the joint positions, shape (3 + n,)."""
    joint, wave = robot.joints[h.joint], np.zeros(robot.n)
    if h["motor"] <= 0.5:
        wave[h.joint] = waves(h, joint)
    elif joint.type == "revolute":
        wave = h.value_or("per_turn", 1.0) * robot.transmission_matrix[h.joint]
    else:
        wave[h.joint] = 2.0 * math.pi * h.value_or("per_turn", 1.0) / h["pitch"]
    return np.concatenate([[h.joint, h["amplitude"], h["phase"]], wave])
