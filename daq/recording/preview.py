"""Channels for looking: some samples of every stream in SI units at the joints, which any viewer plots as they are.

Readers of ours do not use them: what was measured is in the streams, as it came off the bus.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.daq.recording.layout import StreamLayout
from armident.daq.recording.model import Field

PREFIX = "si_"
"""How the topics begin: ``/si_samples`` shows ``/samples``."""


@dataclass(frozen=True)
class PreviewChannel:
    """What is shown of one stream: every ``every``-th SYNC, by ``matrix`` (n, n) from the raw values of each field."""

    layout: StreamLayout
    matrices: tuple[NDArray[np.float64], ...]

    @classmethod
    def at(
        cls, stream: StreamLayout, robot: RobotConfig, sample_rate_hz: float, rate_hz: float
    ) -> "PreviewChannel | None":
        """A view of a stream with at most ``rate_hz`` samples per second; ``None`` if it has nothing to show."""
        every = stream.every * max(1, -(-round(sample_rate_hz) // round(max(rate_hz, 1.0) * stream.every)))
        fields, matrices = [], []
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
        if not fields:
            return None
        layout = StreamLayout(PREFIX + stream.name, every, stream.joints, tuple(fields), ("float64",) * len(fields))
        return cls(layout, tuple(matrices))

    @property
    def metadata(self) -> dict[str, str]:
        """What the channel says of its fields."""
        units = {field.name: f"{field.unit}, {field.side} side" for field in self.layout.fields}
        return units | {"armident.shows": f"every {self.layout.every}th SYNC of /{self.layout.name[len(PREFIX) :]}"}

    def of(
        self, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], dict[str, NDArray[np.float64]]]:
        """The samples shown of rows ``sync`` and ``t_ns`` (N,), ``raw`` (N, n)."""
        shown = np.flatnonzero((sync + 1) % self.layout.every == 0)
        values = {
            field.name: raw[field.name][shown].astype(np.float64) @ matrix.T
            for field, matrix in zip(self.layout.fields, self.matrices, strict=True)
        }
        return sync[shown], t_ns[shown], values
