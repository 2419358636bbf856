"""Repair of recorded signals before anything is computed from them: wraps are undone, impossible rows become gaps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array, Mask
from armident.configs import RobotConfig
from armident.daq.recording.faults.jumps import JumpCriteria, jumps, unwrapped
from armident.daq.recording.faults.stale import frozen_before, frozen_efforts, repeated_efforts
from armident.daq.recording.faults.zeros import rows_beyond, switched_off, zero_rows
from armident.daq.recording.model import Gap, Quantity, Recording, Side

REASON = "impossible values"
"""Reason of the gaps that a repair leaves."""
REPAIRS = "repairs"
"""Key of the metadata with a line for each kind of fault that an import has repaired."""
EFFORTS: tuple[Quantity, ...] = ("torque", "current", "voltage")
CUT = 4
"""Rows that are left out at a step of all joints: longer than the gaps that are interpolated."""
NEAR = 8
"""Rows on either side of a step that tell the velocities there: shorter than a change of a motion at usual rates."""
SLOW = 0.2
"""Velocity over the usual one near a step below which a joint tells nothing of missing rows."""
SAME = 0.1
"""Share of the power of the steps, in usual steps of each joint, that missing rows may leave unexplained."""
_HOLE = 1.5
"""Step of the times over the usual one above which rows are missing between them."""
_SHOWN = 4
"""Times of a fault that a message lists."""


@dataclass(frozen=True)
class Repair:
    """Positions and demand (N, n) without wraps, and a sentence for each kind of fault.

    ``wrong`` (N,): rows to leave out. ``off`` (N,): rows with drives off, which a recording keeps and nobody uses.
    """

    position: Array
    demand: Array | None
    wrong: Mask
    off: Mask
    notes: tuple[str, ...]


def repair(
    position: Array,
    effort: Array,
    demand: Array | None,
    times: Array,
    robot: RobotConfig,
    side: Side,
    *,
    polled: bool = False,
    torque: bool = True,
) -> Repair:
    """Return what of signals (N, n), SI, on one ``side`` of the gears, at times (N,), s, can be used, and why.

    Rows that are missing stay for an import of ``polled`` samples, which counts them by the motion. The effort is a
    ``torque``, or else a current or voltage.
    """
    criteria = JumpCriteria()
    steps = np.diff(times)
    if steps.size < 2 * criteria.near:
        none = np.zeros(times.size, dtype=np.bool_)
        return Repair(position, demand, none, none, ())
    dt = float(np.median(steps))
    holes = np.asarray(steps > _HOLE * dt, dtype=np.bool_)
    names = [joint.name for joint in robot.joints]
    at = times - times[0]
    position = position.copy()
    demand = None if demand is None else demand.copy()
    notes: list[str] = []
    lasting: list[tuple[int, int, float]] = []
    stale: Mask = np.zeros((times.size, robot.n), dtype=np.bool_)
    wrong = np.zeros((times.size, robot.n), dtype=np.bool_)
    for j, joint in enumerate(robot.joints):
        if joint.type == "revolute":
            # 360 where degrees are taken for radians, which the check of units finds then.
            for turn in (2.0 * np.pi, 360.0):
                position[:, j], rows = unwrapped(position[:, j], holes, turn, criteria)
                if rows.size:
                    notes.append(f"the position of {names[j]} wraps by a full turn {_times(rows, at)}: unwrapped")
                    if side == "joint":
                        position[:, j] -= turn * np.rint(_middle(position[:, j], joint.limits.position) / turn)
                    if demand is not None:
                        demand[:, j] = _beside(demand[:, j], position[:, j], holes, turn, criteria)
        limits = (joint.limits.velocity, joint.limits.acceleration) if side == "joint" else (np.inf, np.inf)
        found = jumps(position[:, j], dt, holes, *limits, criteria)
        wrong[:, j] = found.wrong
        for row, size in found.steps:
            if frozen := frozen_before(position[:, j], row, criteria):
                stale[slice(*frozen), j] = True
            else:
                lasting.append((j, row, size))
    for chosen, rows in _alike(stale, names):
        notes.append(f"the position of {chosen} is not renewed {_times(rows, at)}: left out as gaps")
    cuts = set() if polled else shared_steps(position, lasting)
    for row in sorted(cuts):
        notes.append(
            f"the positions of all joints step at {at[row]:.3f} s: rows are missing there, or two recordings are in "
            "one: cut there"
        )
    for chosen, rows in _alike(wrong, names):
        values = position[rows]
        what = "all 0" if not values.any() else "single rows"
        notes.append(
            f"the position of {chosen} is impossible {_times(rows, at)} ({what}; no motion leads there and back): "
            "left out as gaps"
        )
    limits_of = np.array([joint.limits.torque if torque and side == "joint" else np.inf for joint in robot.joints])
    beyond, effort = rows_beyond(effort, limits_of, criteria)
    for chosen, rows in _alike(beyond, names):
        notes.append(
            f"the torque of {chosen} is beyond its limit {_times(rows, at)}, between rows far below: left out as gaps"
        )
    zeros: Mask = zero_rows(effort, holes, criteria)
    known = np.asarray(wrong.any(axis=1), dtype=np.bool_)
    elsewhere = np.asarray(zeros & ~known[:, None], dtype=np.bool_)
    for chosen, rows in _alike(elsewhere, names):
        notes.append(f"the torque of {chosen} is 0 {_times(rows, at)}, between rows where it is not: left out as gaps")
    kept = frozen_efforts(effort, position, criteria) & ~stale
    for chosen, rows in _alike(kept, names):
        notes.append(f"the torque of {chosen} is the same while the joint moves {_times(rows, at)}: left out as gaps")
    copied = repeated_efforts(effort, position)
    if copied.any():
        rows = np.flatnonzero(copied)
        notes.append(f"the torques repeat earlier ones, value by value, {_times(rows, at)}: left out as gaps")
    out = np.asarray((wrong | zeros | stale | kept | beyond).any(axis=1) | copied, dtype=np.bool_)
    off = np.zeros(times.size, dtype=np.bool_)
    for begin, end in switched_off(effort, dt, criteria):
        off[begin:end] = True
        notes.append(
            f"all torques are 0 from {at[begin]:.3f} to {at[end - 1]:.3f} s: drives off or brakes on; that time is not "
            "used"
        )
    for row in cuts:
        out[max(row - CUT // 2, 0) : row + CUT - CUT // 2] = True
    return Repair(position, demand, out, off, tuple(notes))


def shared_steps(position: Array, steps: Sequence[tuple[int, int, float]]) -> set[int]:
    """Rows of lasting steps (joint, row, size) at which not one encoder but all joints (N, n) step.

    Two joints step at once, or all joints by the same number of their own steps: rows are missing there.
    """
    found = set()
    for row in {row for _, row, _ in steps}:
        joints = {j for j, other, _ in steps if abs(other - row) <= 1}
        near = position[max(row - NEAR, 0) : row + NEAR]
        each = np.abs(np.diff(near, axis=0))
        usual = np.quantile(each, JumpCriteria().quantile, axis=0)
        moved = usual > 0
        slope = np.median(np.diff(near, axis=0), axis=0)[moved] / usual[moved]
        size = (position[row] - position[row - 1])[moved] / usual[moved]
        several = int((np.abs(slope) > SLOW).sum()) > 1
        missing = float(size @ slope) / max(float(slope @ slope), 1e-300)
        left = float(np.sum((size - missing * slope) ** 2)) / max(float(size @ size), 1e-300)
        if len(joints) > 1 or (several and missing > 1.0 and left < SAME):
            found.add(row)
    return found


def repaired(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """Return a recording with its faults repaired, the same if it has none, and a sentence for each kind."""
    before = tuple(line for line in recording.metadata.get(REPAIRS, "").split("\n") if line)
    samples, robot = recording.samples, recording.robot
    position = samples.named("position")
    effort = next((name for quantity in EFFORTS if (name := samples.named(quantity))), None)
    if position is None or effort is None or samples.sync.size < 2:
        return recording, before
    q, tau = samples.si(position), samples.si(effort)
    if not (np.isfinite(q).all() and np.isfinite(tau).all()):
        return recording, before
    where = next(((n, s) for n, s in recording.streams.items() if s.named("demand") is not None), None)
    own = where is not None and where[1] is samples
    demand = samples.named("demand")
    qr = samples.si(demand) if own and demand is not None else None
    times = samples.sync / recording.sample_rate_hz
    torque = samples.named("torque") is not None
    found = repair(q, tau, qr, times, robot, samples.fields[position].side, torque=torque)
    if not found.notes:
        return recording, before
    raw = dict(samples.raw)
    if not np.array_equal(found.position, q):
        raw[position] = found.position / np.asarray(samples.fields[position].scale)
        if demand is not None and found.demand is not None:
            raw[demand] = found.demand / np.asarray(samples.fields[demand].scale)
    kept: Mask = np.asarray(~(found.wrong | found.off), dtype=np.bool_)
    lost = samples.sync[~kept]
    made = replace(
        samples,
        sync=samples.sync[kept],
        t_ns=samples.t_ns[kept],
        raw={name: values[kept] for name, values in raw.items()},
    )
    counters = dict(recording.counters)
    for name, change in (("rows", -lost.size), ("in_gaps", lost.size)):
        key = f"{samples.name}.{name}"
        if key in counters:
            counters[key] += change
    gaps = (*recording.gaps, *(Gap(samples.name, a, b, reason=REASON) for a, b in _ranges(lost)))
    streams = {**recording.streams, samples.name: made}
    return replace(recording, streams=streams, gaps=gaps, counters=counters), tuple(
        dict.fromkeys([*before, *found.notes])
    )


def _ranges(sync: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First and last of each range of consecutive numbers (N,)."""
    parts = np.split(sync, np.flatnonzero(np.diff(sync) != 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts if part.size]


def _alike(wrong: Mask, names: Sequence[str]) -> list[tuple[str, NDArray[np.int64]]]:
    """Joints with wrong rows (N, n), those with the same rows together, and the rows."""
    groups: dict[bytes, list[int]] = {}
    for j in np.flatnonzero(wrong.any(axis=0)):
        groups.setdefault(wrong[:, j].tobytes(), []).append(int(j))
    return [(", ".join(names[j] for j in each), np.flatnonzero(wrong[:, each[0]])) for each in groups.values()]


def _times(rows: NDArray[np.int64], at: Array) -> str:
    """Number of rows, and the times of the first of them, for messages."""
    shown = ", ".join(f"{at[k]:.3f}" for k in rows[:_SHOWN])
    more = ", ..." if rows.size > _SHOWN else ""
    return f"in {rows.size} row{'s' if rows.size > 1 else ''} (at {shown}{more} s)"


def _middle(x: Array, limits: tuple[float, float]) -> float:
    """Distance of the middle of a position (N,) from that of its limits; 0 without limits."""
    return float((x.min() + x.max() - sum(limits)) / 2.0) if np.isfinite(limits).all() else 0.0


def _beside(demand: Array, position: Array, holes: Mask, turn: float, criteria: JumpCriteria) -> Array:
    """Demand (N,) without wraps, on the same turn as the position; rows without a demand are passed over."""
    rows = np.flatnonzero(np.isfinite(demand))
    if rows.size < 2:
        return demand
    before = np.concatenate([[0], np.cumsum(holes)])
    x, _ = unwrapped(demand[rows], np.asarray(np.diff(before[rows]) > 0), turn, criteria)
    made = demand.copy()
    made[rows] = x - turn * np.rint(np.median(x - position[rows]) / turn)
    return made
