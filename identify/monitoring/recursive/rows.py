"""Rows of positions, torques and reference positions from blocks of the stream, matched by SYNC number."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.daq.recording import Field, StreamLayout
from armident.identify.identification.set_points import between_set_points
from armident.identify.monitoring.recursive.kernels import to_joint_side

EFFORTS: tuple[Literal["torque", "current", "voltage"], ...] = ("torque", "current", "voltage")
LONGEST_WAIT = 8192
"""Samples of earlier blocks that wait for their reference positions; older ones are counted as lost."""


class SampleBlock(Protocol):
    """Consecutive rows of one stream, as `armident.daq.streaming.Block` has them."""

    @property
    def layout(self) -> StreamLayout:
        """Layout of the stream."""

    @property
    def sync(self) -> NDArray[np.int64]:
        """SYNC numbers (N,)."""

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Receive times (N,), ns UTC."""

    @property
    def raw(self) -> Mapping[str, NDArray[Any]]:
        """Raw values of every field, (N, n) each."""


class RowMatcher:
    """Hands over rows with position, torque and reference in the order of SYNC, from blocks in any cutting.

    ``take``: SYNC numbers (N,) and values (N, w), n columns each, joint side, SI; a reference waits for the next
    report.
    """

    _saved = (
        "sync",
        "values",
        "knot_sync",
        "knots",
        "last_ns",
        "last_sync",
        "demand_every",
        "without_reference",
        "repeated",
    )

    def __init__(
        self, robot: RobotConfig, with_reference: bool, take: Callable[[NDArray[np.int64], Array], None]
    ) -> None:
        self._robot, self._take = robot, take
        self._ratio = robot.transmission_matrix
        self._inverse = np.linalg.inv(self._ratio)
        self.with_reference = with_reference
        self.start_capture()

    def start_capture(self) -> None:
        """Expect the blocks of another capture, whose SYNC numbers begin anew."""
        n = self._robot.n
        self.sync = np.empty(0, np.int64)
        self.values = np.empty((0, 2 * n))
        self.knot_sync = np.empty(0, np.int64)
        self.knots = np.empty((0, n))
        self.last_ns, self.last_sync, self.demand_every = -1, -1, 1
        self.without_reference, self.repeated = 0, 0

    def add(self, block: SampleBlock) -> bool:
        """Take over a block of any stream; True if another capture begins: SYNC numbers begin anew at a later time."""
        layout = block.layout
        names = tuple(joint.name for joint in self._robot.joints)
        if layout.joints != names:
            raise DataError(
                f"the stream has the joints {', '.join(layout.joints)}, the robot {self._robot.name} {', '.join(names)}"
            )
        if not block.sync.size:
            return False
        if layout.name == "samples":
            return self._add_samples(block)
        demand = _named(layout, "demand")
        if demand is not None and self.with_reference:
            self._add_knots(block, demand)
        return False

    def _add_samples(self, block: SampleBlock) -> bool:
        started = False
        if int(block.sync[0]) <= self.last_sync and int(block.t_ns[0]) > self.last_ns >= 0:
            self.start_capture()
            started = True
        fresh = block.sync > self.last_sync
        self.repeated += int(np.count_nonzero(~fresh))
        if not fresh.any():
            return started
        self.last_sync, self.last_ns = int(block.sync[-1]), int(block.t_ns[-1])
        sync, values = block.sync[fresh], self._converted(block)[fresh]
        demand = _named(block.layout, "demand")
        if not self.with_reference:
            self._hand_over(sync, values)
        elif demand is not None:
            self._hand_over(sync, np.hstack([values, self._positions(block, demand)[fresh]]))
        else:
            surplus = max(self.sync.size - LONGEST_WAIT, 0)
            self.without_reference += surplus
            self.sync, self.values = self.sync[surplus:], self.values[surplus:]
            self.sync = np.concatenate([self.sync, sync])
            self.values = np.concatenate([self.values, values])
            self._match()
        return started

    def _add_knots(self, block: SampleBlock, demand: Field) -> None:
        last = int(self.knot_sync[-1]) if self.knot_sync.size else -1
        fresh = block.sync > last
        self.demand_every = block.layout.every
        self.knot_sync = np.concatenate([self.knot_sync, block.sync[fresh]])
        self.knots = np.concatenate([self.knots, self._positions(block, demand)[fresh]])
        self._match()

    def _match(self) -> None:
        """Hand over the samples up to the last report of the reference, interpolated as the drives do."""
        knots = self.knot_sync
        last = int(knots[-1]) if knots.size else -1
        ready = int(np.searchsorted(self.sync, last, side="right"))
        if ready:
            sync, values = self.sync[:ready], self.values[:ready]
            known, low, high, share = between_set_points(knots, self.demand_every, sync)
            reference = self.knots[low] + share * (self.knots[high] - self.knots[low])
            self.without_reference += int(np.count_nonzero(~known))
            self._hand_over(sync[known], np.hstack([values, reference])[known])
            self.sync, self.values = self.sync[ready:], self.values[ready:]
            # The next sample is after the last one handed over; reports may be ahead of the samples.
            keep = max(int(np.searchsorted(knots, sync[-1], side="right")) - 1, 0)
            self.knot_sync, self.knots = knots[keep:], self.knots[keep:]

    def _hand_over(self, sync: NDArray[np.int64], values: Array) -> None:
        finite = np.isfinite(values).all(axis=1)
        if sync.size:
            self._take(sync[finite], values[finite])

    def _converted(self, block: SampleBlock) -> Array:
        """Positions and torques of the joints, (N, 2 n)."""
        position = _named(block.layout, "position")
        if position is None:
            raise DataError(f"stream {block.layout.name!r} has no position")
        return np.hstack([self._positions(block, position), self._torques(block)])

    def _positions(self, block: SampleBlock, field: Field) -> Array:
        values = _si(block, field)
        if field.side == "joint":
            return values
        out = np.empty(values.shape)
        to_joint_side(values, np.asarray(self._inverse, dtype=np.float64), out)
        return out

    def _torques(self, block: SampleBlock) -> Array:
        wanted = self._robot.joints[0].drive.signal
        for quantity in sorted(EFFORTS, key=lambda effort: effort != wanted):
            field = _named(block.layout, quantity)
            if field is None:
                continue
            values = _si(block, field)
            if quantity == "torque" and field.side == "joint":
                return values
            if quantity != "torque":
                values = values * np.array([joint.drive.gain for joint in self._robot.joints], dtype=np.float64)
            out = np.empty(values.shape)
            to_joint_side(np.asarray(values, dtype=np.float64), np.ascontiguousarray(self._ratio.T), out)
            return out
        raise DataError(f"stream {block.layout.name!r} has no current, voltage or torque")


def _named(layout: StreamLayout, quantity: str) -> Field | None:
    return next((field for field in layout.fields if field.quantity == quantity), None)


def _si(block: SampleBlock, field: Field) -> Array:
    values = block.raw[field.name].astype(np.float64) * np.asarray(field.scale)
    return np.ascontiguousarray(values, dtype=np.float64)
