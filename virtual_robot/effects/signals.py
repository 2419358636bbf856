"""Hidden errors between plant, drives and what is recorded: encoders, amplifiers, wiring, names."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from configs import RobotConfig
from virtual_robot.effects.forces import waves
from virtual_robot.effects.hidden import Hidden

Vector = NDArray[np.float64]


class Signals:
    """What becomes of positions and signals on their way, once per control period.

    Parameters
    ----------
    hidden
        Effects; those of other places are ignored.
    robot
        Transmission and drives.
    period
        Control period, s.

    Attributes
    ----------
    acts
        Whether there is anything to do.
    swapped
        Whether positions, demands or signals are recorded under other names or signs.
    """

    def __init__(self, hidden: Sequence[Hidden], robot: RobotConfig, period: float) -> None:
        mine = [h for h in hidden if h.place in ("drive", "report")]
        self.acts = bool(mine)
        self.swapped = any(h.effect in ("sign_error", "joint_order") for h in mine)
        n, ratio = robot.n, robot.transmission_matrix
        self._period, self._periods = period, 0
        gain = np.array([joint.drive.gain for joint in robot.joints])
        joint_gain = gain * np.diag(ratio)

        self._encoders = [_encoder(h, robot) for h in mine if h.effect == "encoder_eccentricity"]
        self._to_joints = np.linalg.inv(ratio) * np.diag(ratio)

        self._torque = ratio.T * gain
        self._level, self._knee, self._lag = np.ones(n), np.full(n, np.inf), np.zeros(n)
        self._lagging = np.zeros(n)
        for h in mine:
            if h.effect == "drive_gain_error":
                self._level[h.joint] += h["error"]
            elif h.effect == "drive_gain_saturation":
                torque = h.given("torque", 0.5 * robot.joints[h.joint].limits.torque)
                signal = abs(torque / joint_gain[h.joint])
                self._knee[h.joint] = signal / math.sqrt((1.0 - h["drop"]) ** -2 - 1.0)
            elif h.effect == "actuator_bandwidth":
                self._lag[h.joint] = h["time_constant"]

        self._delay = np.zeros(n)
        self._leak = np.eye(n)
        self._ripple: list[tuple[int, float, float, float]] = []
        for h in mine:
            if h.effect == "time_delay":
                self._delay[h.joint] = h["delay"] / period
            elif h.effect == "current_crosstalk":
                self._leak[h.joint, h.other] += h["share"] * joint_gain[h.other] / joint_gain[h.joint]
            elif h.effect == "mains_ripple":
                amplitude = h["amplitude"] / joint_gain[h.joint]
                self._ripple.append((h.joint, amplitude, 2.0 * math.pi * h["frequency"], h["phase"]))
        self._past = np.zeros((int(self._delay.max()) + 2, n))

        self.torque_from, self.torque_sign = np.arange(n), np.ones(n)
        self.position_from, self.position_sign = np.arange(n), np.ones(n, np.int32)
        for h in mine:
            if h.effect == "sign_error":
                self.torque_sign[h.joint] *= -1.0 if h["torque"] > 0.5 else 1.0
                self.position_sign[h.joint] *= -1 if h["position"] > 0.5 else 1
            elif h.effect == "joint_order":
                both, turned = [h.joint, h.other], [h.other, h.joint]
                for name, origin, sign in (
                    ("torque", self.torque_from, self.torque_sign),
                    ("position", self.position_from, self.position_sign),
                ):
                    if h[name] > 0.5:
                        origin[both], sign[both] = origin[turned], sign[turned]

    def measured(self, q: Vector) -> Vector:
        """Joint positions (n,) as the encoders have them."""
        if not self._encoders:
            return q
        error = np.zeros(q.size)
        for joint, amplitude, wave, phase in self._encoders:
            error[joint] += amplitude * math.sin(float(wave @ q) + phase)
        out: Vector = q + self._to_joints @ error
        return out

    def applied(self, signal: Vector) -> Vector:
        """Joint torques (n,) that the motors give over the coming period at the drives' ``signal`` (n,)."""
        mean = signal
        if self._lag.any():
            # The mean of the exponential over the period, which the plant holds.
            with np.errstate(divide="ignore"):
                left = np.exp(-self._period / self._lag)
            away = self._lagging - signal
            mean = signal + away * self._lag / self._period * (1.0 - left)
            self._lagging = signal + away * left
        saturated = self._level * mean / np.sqrt(1.0 + (mean / self._knee) ** 2)
        out: Vector = self._torque @ saturated
        return out

    def reported(self, signal: Vector) -> Vector:
        """The drives' ``signal`` (n,) as it is reported now, before noise, in the drives' own order."""
        self._past = np.roll(self._past, 1, axis=0)
        self._past[0] = signal
        whole = self._delay.astype(np.int64)
        part, column = self._delay - whole, np.arange(signal.size)
        out: Vector = (1.0 - part) * self._past[whole, column] + part * self._past[whole + 1, column]
        out = self._leak @ out
        t = self._periods * self._period
        for joint, amplitude, rate, phase in self._ripple:
            out[joint] += amplitude * math.sin(rate * t + phase)
        self._periods += 1
        return out


def _encoder(h: Hidden, robot: RobotConfig) -> tuple[int, float, Vector, float]:
    """Joint, amplitude, wave numbers over the joint positions (n,), phase."""
    joint, wave = robot.joints[h.joint], np.zeros(robot.n)
    if h["motor"] <= 0.5:
        wave[h.joint] = waves(h, joint)
    elif joint.type == "revolute":
        wave = h.given("per_turn", 1.0) * robot.transmission_matrix[h.joint]
    else:
        wave[h.joint] = 2.0 * math.pi * h.given("per_turn", 1.0) / h["pitch"]
    return h.joint, h["amplitude"], wave, h["phase"]
