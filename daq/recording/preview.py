"""Preview channels: a part of each stream's samples in SI units at the joints, for viewers of MCAP files only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.model import Field

PREFIX = "si_"
"""Prefix of the topics: ``/si_samples`` shows ``/samples``."""

JOINT_TORQUE = "joint_torque"
"""Field with the torque at the joints that follows from the reported currents or voltages."""


@dataclass(frozen=True)
class PreviewChannel:
    """Preview of one stream every ``layout.every`` SYNCs; each field has its raw one and a matrix (n, n) to SI."""

    layout: StreamLayout
    matrices: tuple[Array, ...]
    sources: tuple[str, ...]

    @classmethod
    def of_stream(
        cls, stream: StreamLayout, robot: RobotConfig, sample_rate_hz: float, rate_hz: float
    ) -> "PreviewChannel | None":
        """Return the preview of a stream, at most at ``rate_hz``; ``None`` if it has nothing but status words."""
        every = stream.every * max(1, -(-round(sample_rate_hz) // round(max(rate_hz, 1.0) * stream.every)))
        fields: list[Field] = []
        matrices: list[Array] = []
        sources: list[str] = []
        for field in stream.fields:
            if field.quantity == "status":
                continue
            scale, side = np.diag(field.scale), field.side
            if side == "motor" and field.quantity in ("position", "velocity", "demand"):
                # q_motor = R q_joint
                scale, side = np.linalg.inv(robot.transmission_matrix) @ scale, "joint"
            elif side == "motor" and field.quantity == "torque":
                # tau_joint = R' tau_motor
                scale, side = robot.transmission_matrix.T @ scale, "joint"
            fields.append(Field(field.name, field.quantity, field.unit, side, (1.0,) * len(stream.joints)))
            matrices.append(scale)
            sources.append(field.name)
        torque = _joint_torque(stream, robot)
        if torque is not None:
            fields.append(Field(JOINT_TORQUE, "torque", _torque_unit(robot), "joint", (1.0,) * len(stream.joints)))
            matrices.append(torque[1])
            sources.append(torque[0])
        if not fields:
            return None
        layout = StreamLayout(PREFIX + stream.name, every, stream.joints, tuple(fields), ("float64",) * len(fields))
        return cls(layout, tuple(matrices), tuple(sources))

    @property
    def metadata(self) -> dict[str, str]:
        """Channel metadata with unit and side of every field."""
        units = {field.name: f"{field.unit}, {field.side} side" for field in self.layout.fields}
        return units | {"armident.shows": f"every {self.layout.every}th SYNC of /{self.layout.name[len(PREFIX) :]}"}

    def select(
        self, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], dict[str, Array]]:
        """Return SYNC numbers, times (M,), ns UTC, and SI values (M, n) of the preview, from raw (N, n) by field."""
        shown = np.flatnonzero((sync + 1) % self.layout.every == 0)
        values = {
            field.name: raw[source][shown].astype(np.float64) @ matrix.T
            for field, source, matrix in zip(self.layout.fields, self.sources, self.matrices, strict=True)
        }
        return sync[shown], t_ns[shown], values


def _joint_torque(stream: StreamLayout, robot: RobotConfig) -> tuple[str, Array] | None:
    """Return the field of the drives' effort and its matrix (n, n) to joint torques; ``None`` without such a field.

    ``tau_joint = R' diag(gain) signal`` (thesis equation 2.14); ``None`` also if the stream has a torque.
    """
    signals = {joint.drive.signal for joint in robot.joints}
    if len(signals) != 1 or any(field.quantity == "torque" for field in stream.fields):
        return None
    for field in stream.fields:
        if field.quantity in signals and field.side == "motor":
            gains = np.array([joint.drive.gain for joint in robot.joints])
            return field.name, robot.transmission_matrix.T @ np.diag(gains * np.array(field.scale))
    return None


def _torque_unit(robot: RobotConfig) -> str:
    kinds = {joint.type for joint in robot.joints}
    return "N m" if kinds == {"revolute"} else "N" if kinds == {"prismatic"} else "N m|N"
