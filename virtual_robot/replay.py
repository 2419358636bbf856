"""Replay of a recording through the virtual drives."""

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.configs.units import counts_per_si
from armident.daq.recording import Recording, Stream
from armident.virtual_robot.arm import Raw32

RATE_TOLERANCE = 1e-3
"""Largest relative difference of the recording's sample rate and the SYNC rate."""


class Replay:
    """Drive backend that replays positions and currents of a recording, one sample per SYNC.

    The first sample is repeated until all drives of ``joints`` are enabled, the last one at the end, and in a gap the
    one before. Set points are ignored.
    """

    def __init__(self, recording: Recording, robot: RobotConfig, sync_period: float, joints: tuple[int, ...]) -> None:
        where = str(recording.path or "recording")
        if recording.robot.name != robot.name or recording.robot.n != robot.n:
            raise ConfigError(
                f"{where}: a recording of {recording.robot.name!r} ({recording.robot.n} joints), "
                f"this session's robot is {robot.name!r} ({robot.n} joints)"
            )
        if abs(recording.sample_rate_hz * sync_period - 1) > RATE_TOLERANCE:
            raise ConfigError(
                f"{where}: sampled at {recording.sample_rate_hz:g} Hz, "
                f"but the session's sync.period_us asks for {1 / sync_period:g} Hz"
            )
        samples = recording.samples
        if not samples.sync.size:
            raise DataError(f"{where}: holds no samples to replay")
        rows = np.searchsorted(samples.sync, np.arange(samples.sync[0], samples.sync[-1] + 1), side="right") - 1
        self._positions = _counts(samples, robot, "position", where)[rows]
        self._currents = _permille(samples, robot, where)[rows]
        self._demands = self._demand(recording, robot, where)
        self._row = 0
        self._waiting = set(joints)
        self.position = self._positions[0].copy()
        self.current = self._currents[0].copy()
        self.demand = self._demands[0].copy()

    def _demand(self, recording: Recording, robot: RobotConfig, where: str) -> Raw32:
        stream = next((s for s in recording.streams.values() if s.named("demand")), None)
        if stream is None or not stream.sync.size:
            return self._positions
        first = recording.samples.sync[0]
        at = np.searchsorted(stream.sync, np.arange(first, first + len(self._positions)), side="right") - 1
        return _counts(stream, robot, "demand", where)[np.maximum(at, 0)]

    @property
    def finished(self) -> bool:
        """``True`` if the last sample has been reached."""
        return self._row == len(self._positions) - 1

    def enable(self, joint: int, enabled: bool) -> None:
        """Start the replay when the last drive is enabled. ``enabled``: new state of its drive."""
        if enabled:
            self._waiting.discard(joint)

    def set_targets(self, targets: Raw32, fresh: NDArray[np.bool_]) -> None:
        """Ignore set points. ``targets``, ``fresh``: as in `DriveBackend.set_targets`."""

    def advance(self) -> None:
        """Advance to the next sample."""
        if self._waiting or self.finished:
            return
        self._row += 1
        self.position[:] = self._positions[self._row]
        self.current[:] = self._currents[self._row]
        self.demand[:] = self._demands[self._row]


def _counts(stream: Stream, robot: RobotConfig, quantity: str, where: str) -> Raw32:
    """Motor positions of a stream in counts, shape (N, n)."""
    name = stream.named("position" if quantity == "position" else "demand")
    if name is None:
        raise DataError(f"{where}: has no positions to replay")
    motor = stream.si(name)
    if stream.fields[name].side == "joint":
        motor = motor @ robot.transmission_matrix.T
    counts = np.rint(motor * counts_per_si(robot))
    if not np.isfinite(counts).all() or np.abs(counts).max() > np.iinfo(np.int32).max:
        raise DataError(f"{where}: {name} does not fit into 32 bits of encoder counts")
    return counts.astype(np.int32)


def _permille(stream: Stream, robot: RobotConfig, where: str) -> NDArray[np.int16]:
    """Motor currents of a stream in per mille of rated, shape (N, n)."""
    name = stream.named("current") or stream.named("torque")
    if name is None:
        raise DataError(f"{where}: has neither currents nor torques to replay")
    field, values = stream.fields[name], stream.si(name)
    if field.quantity == "torque":
        if field.side == "joint":
            values = values @ np.linalg.inv(robot.transmission_matrix)
        values = values / np.array([joint.drive.gain for joint in robot.joints])
    permille = np.rint(values * 1000.0 / np.array([joint.drive.rated for joint in robot.joints]))
    if not np.isfinite(permille).all():
        raise DataError(f"{where}: {name} holds values that are not numbers")
    if np.abs(permille).max() > np.iinfo(np.int16).max:
        joint = robot.joints[int(np.abs(permille).max(axis=0).argmax())].name
        raise DataError(f"{where}: {name} of {joint} exceeds 32 times the rated current")
    fitting: NDArray[np.int16] = permille.astype(np.int16)
    return fitting
