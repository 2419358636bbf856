"""Experiments from a recording, read from a file or assembled from the stream."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError, Joint, RobotConfig
from armident.configs.schema.limits import ENDLESS
from armident.daq.recording import Recording, Stream
from armident.daq.recording.faults.repair import REASON, repaired
from armident.daq.recording.faults.zeros import NOTHING
from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.identification.set_points import between_set_points
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import OnDisk, Streamed

MAX_MISSING_SHARE = 0.05
"""Largest share of missing samples of an experiment; with more, the rest is no longer the designed motion."""
MIN_PIECE_S = 0.5
"""Shortest piece between two gaps, s: edge effects of the filters cover shorter ones."""
RATE_TOLERANCE = 0.01
"""Relative difference between the nominal rate and the receive times above which a note is added."""
OUTSIDE, TORN = "outside its limits", "the recording is torn"
"""Parts of the notes on positions that pass the limits of their joint, and on a file that was not finished."""
NO_REFERENCE = "no reference trajectory was recorded: identified without one"
"""Note on a recording without demands."""
BRIDGED = 2
"""Missing samples that are interpolated: a cubic through their neighbours errs by less than the noise where the rate
gives ten samples per period of the motion. Longer gaps separate pieces."""
PIECE = 1_000_000
"""Number of samples whose references are looked up at a time."""
EFFORTS: tuple[Literal["torque", "current", "voltage"], ...] = ("torque", "current", "voltage")


@dataclass(frozen=True)
class StretchRule:
    """Size from which a recording is identified in stretches, of which one is in memory at a time.

    In values (samples times joints), each of up to 260 bytes in an identification; ``length`` of a stretch.
    """

    beyond: int = 12_000_000
    length: int = 3_000_000


WHOLE = StretchRule(beyond=2**62)
"""No recording is cut."""


def experiments_from_recording(
    recording: Recording, robot: RobotConfig, stretches: StretchRule = WHOLE
) -> tuple[Sequence[Experiment], list[str]]:
    """Experiments of a recording in SI units on the joint side, cut at the experiment marks and at gaps; and remarks.

    Joint positions are ``R^-1 q_motor`` and joint torques ``R' tau_motor`` (thesis equation 2.14 and section B.1). The
    reference between set points is straight, as a CiA 402 drive interpolates (60C2h). Raises ConfigError or DataError.
    """
    try:
        robot.check_filled("identify")
        return _converted(recording, robot, stretches)
    except DataError as error:
        if recording.path is None:
            raise
        raise DataError(f"{recording.path}: {error}") from error


def _converted(
    recording: Recording, robot: RobotConfig, stretches: StretchRule
) -> tuple[Sequence[Experiment], list[str]]:
    check_same_robot(recording.robot, robot)
    _check_counters(recording)
    long = recording.samples.sync.size * robot.n > stretches.beyond
    remarks: Sequence[str] = ()
    if not long:
        recording, remarks = repaired(recording)
    left_out = [np.arange(gap.first, gap.last + 1) for gap in recording.gaps if gap.reason == REASON]
    recorded = np.concatenate([recording.samples.sync, *left_out])
    notes = list(remarks)
    if recording.missing:
        notes.append(f"{TORN}: {recording.missing}")
    samples = recording.samples
    dt = 1.0 / recording.sample_rate_hz
    demand = _demand_stream(recording)
    has_ref = np.ones(samples.sync.size, dtype=bool) if demand is None else _has_reference(demand, samples.sync)
    if demand is None:
        notes.append(NO_REFERENCE)
    used: list[NDArray[np.int64]] = []
    for first, last in recording.experiments():
        inside = (samples.sync >= first) & (samples.sync <= last)
        _check_missing(int(((recorded >= first) & (recorded <= last)).sum()), first, last, dt)
        rows = np.flatnonzero(inside & has_ref)
        lost_reference = int(inside.sum()) - rows.size
        if lost_reference > MAX_MISSING_SHARE * max(int(inside.sum()), 1):
            raise DataError(f"the reference is missing for {lost_reference} of {int(inside.sum())} samples")
        cuts = np.flatnonzero(np.diff(samples.sync[rows]) > BRIDGED + 1) + 1
        pieces = [piece for piece in np.split(rows, cuts) if piece.size]
        long_enough = [piece for piece in pieces if piece.size * dt >= MIN_PIECE_S]
        if len(pieces) > 1:
            lost = last - first + 1 - int(inside.sum())
            notes.append(
                f"{lost} of {last - first + 1} samples missing: {len(pieces)} pieces, "
                f"{len(long_enough)} of them longer than {MIN_PIECE_S} s are used"
            )
        for piece in long_enough:
            used += np.array_split(piece, -(-piece.size * robot.n // stretches.length)) if long else [piece]
    if not used:
        raise DataError(
            f"the recording has no uninterrupted piece of {MIN_PIECE_S} s inside its experiment marks "
            f"({samples.sync.size} samples in all{f'; {recording.missing}' if recording.missing else ''})"
        )
    experiments: Sequence[Experiment]
    if long:
        for name in samples.raw:
            if samples.raw[name].dtype.kind == "f" and not np.isfinite(samples.raw[name]).all():
                _finite(samples, name, robot)
        notes.append(f"a long recording: identified in {len(used)} stretches, of which one is in memory at a time")
        begin = int(samples.sync[0])
        experiments = OnDisk(_of_stretches(recording, robot, used, begin, notes))
    else:
        experiments = _experiments(recording, robot, used, int(samples.sync[0]))
    notes += _signal_notes(experiments, robot)
    notes += _rate_notes(recording)
    return experiments, notes


def experiments_of(
    recordings: Sequence[Recording], robot: RobotConfig, *, name_files: bool, stretches: StretchRule = WHOLE
) -> tuple[Sequence[Experiment], list[str]]:
    """Experiments of recordings in order, and remarks, which begin with the file if ``name_files``."""
    found: list[Sequence[Experiment]] = []
    notes: list[str] = []
    if sum(recording.samples.sync.size for recording in recordings) * robot.n > stretches.beyond:
        stretches = StretchRule(0, stretches.length)
    for recording in recordings:
        experiments, remarks = experiments_from_recording(recording, robot, stretches)
        found.append(experiments)
        named = name_files and recording.path is not None
        notes += [f"{recording.path.name}: {remark}" if named and recording.path else remark for remark in remarks]
    if len(found) == 1:
        return found[0], notes
    joined = chain.from_iterable(found)
    return OnDisk(joined) if isinstance(found[0], Streamed) else list(joined), notes


def _of_stretches(
    recording: Recording, robot: RobotConfig, used: Sequence[NDArray[np.int64]], begin: int, notes: list[str]
) -> Iterator[Experiment]:
    """Experiments of the stretches of a long recording, repaired one by one; ``notes`` takes what was repaired."""
    for rows in used:
        part, lines = repaired(_part(recording, rows))
        start = (int(recording.samples.sync[rows[0]]) - begin) / recording.sample_rate_hz
        notes += [f"in the stretch from {start:.1f} s on, {line}" for line in lines]
        sync = part.samples.sync
        pieces = np.split(np.arange(sync.size), np.flatnonzero(np.diff(sync) > BRIDGED + 1) + 1)
        chosen = [piece for piece in pieces if piece.size >= MIN_PIECE_S * recording.sample_rate_hz]
        yield from _experiments(part, robot, chosen, begin)


def _experiments(
    recording: Recording, robot: RobotConfig, pieces: Sequence[NDArray[np.int64]], begin: int
) -> list[Experiment]:
    """Experiments of some rows (each consecutive) of a recording that began at SYNC number ``begin``."""
    samples, dt, demand = recording.samples, 1.0 / recording.sample_rate_hz, _demand_stream(recording)
    q = joint_positions(samples, "position", robot)
    tau = joint_torques(samples, robot)
    q_ref = None if demand is None else _reference(demand, samples, robot)
    return [
        Experiment(
            q=_bridged(q[rows], samples.sync[rows], _spline),
            tau=_bridged(tau[rows], samples.sync[rows], _linear),
            q_ref=None if q_ref is None else _bridged(q_ref[rows], samples.sync[rows], _linear),
            dt=dt,
            start=float(samples.sync[rows[0]] - begin) * dt,
            source="" if recording.path is None else str(recording.path),
        )
        for rows in pieces
    ]


def _spline(at: Array, x: Array) -> Callable[[Array], Array]:
    """Cubic spline through values (N, n) at increasing places (N,); its library is imported for a gap only."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(at, x)


def _linear(at: Array, x: Array) -> Callable[[Array], Array]:
    """Piecewise linear function through values (N, n) at increasing places (N,)."""
    return lambda t: np.stack([np.interp(t, at, column) for column in x.T], axis=1)


def _bridged(x: Array, sync: NDArray[np.int64], through: Callable[[Array, Array], Callable[[Array], Array]]) -> Array:
    """Signals (N, n) at SYNC numbers (N,) with the missing samples between them, which ``through`` interpolates."""
    every = np.arange(sync[0], sync[-1] + 1)
    if every.size == sync.size:
        return x
    known = np.isin(every, sync)
    whole = np.empty((every.size, x.shape[1]))
    whole[known] = x
    whole[~known] = through(sync.astype(np.float64), x)(every[~known].astype(np.float64))
    return whole


def _part(recording: Recording, rows: NDArray[np.int64]) -> Recording:
    """Recording of consecutive rows of the samples, with the rows of other streams on both sides of each."""
    first, last = int(rows[0]), int(rows[-1])
    spans = {"samples": slice(first, last + 1)}
    begin, end = recording.samples.sync[[first, last]]
    for name, stream in recording.streams.items():
        if name != "samples":
            before = max(min(int(np.searchsorted(stream.sync, begin, side="right")) - 1, stream.sync.size - 2), 0)
            after = max(int(np.searchsorted(stream.sync, end, side="left")) + 1, before + 2)
            spans[name] = slice(before, after)
    streams = {
        name: replace(
            stream,
            sync=stream.sync[spans[name]],
            t_ns=stream.t_ns[spans[name]],
            raw={field: values[spans[name]] for field, values in stream.raw.items()},
        )
        for name, stream in recording.streams.items()
    }
    return replace(recording, streams=streams)


def joint_positions(stream: Stream, quantity: Literal["position", "demand", "velocity"], robot: RobotConfig) -> Array:
    """Position, demand or velocity of a stream, joint side, (N, n), SI; DataError if it is missing or not finite."""
    name = stream.named(quantity)
    if name is None:
        raise DataError(f"stream {stream.name!r} has no {quantity}; it has {', '.join(sorted(stream.fields))}")
    values = _finite(stream, name, robot)
    if stream.fields[name].side == "motor":
        values = np.asarray(np.linalg.solve(robot.transmission_matrix, values.T).T, dtype=np.float64)
    return np.ascontiguousarray(values)


def joint_torques(stream: Stream, robot: RobotConfig) -> Array:
    """Joint torques from the signals of the drives, shape (N, n), N m or N; DataError if missing or not finite."""
    wanted = robot.joints[0].drive.signal
    for quantity in sorted(EFFORTS, key=lambda effort: effort != wanted):
        name = stream.named(quantity)
        if name is None:
            continue
        values = _finite(stream, name, robot)
        if quantity != "torque":
            if wanted == "torque":
                raise DataError(
                    f"stream {stream.name!r} has a {quantity} of each motor, but drive.signal of {robot.name} is "
                    f"{wanted}: record that, or set drive.signal: {quantity} and the gain of each motor, "
                    f"{'N m/A' if quantity == 'current' else 'N m/V'}, in the robot configuration, and give it by "
                    "--config"
                )
            values = values * np.array([joint.drive.gain for joint in robot.joints])
        elif stream.fields[name].side == "joint":
            return np.ascontiguousarray(values)
        return np.ascontiguousarray(values @ robot.transmission_matrix)
    raise DataError(
        f"stream {stream.name!r} has no current, voltage or torque; it has {', '.join(sorted(stream.fields))}"
    )


def check_same_robot(recorded: RobotConfig, robot: RobotConfig) -> None:
    """Raise DataError if two configurations differ in name, joints or transmission."""
    differences = []
    if recorded.name != robot.name:
        differences.append(f"named {recorded.name!r} / {robot.name!r}")
    if recorded.n != robot.n:
        differences.append(f"{recorded.n} / {robot.n} joints")
    elif [j.name for j in recorded.joints] != [j.name for j in robot.joints]:
        differences.append(
            f"joints {', '.join(j.name for j in recorded.joints)} / {', '.join(j.name for j in robot.joints)}"
        )
    elif not np.allclose(recorded.transmission_matrix, robot.transmission_matrix, rtol=1e-9, atol=0):
        differences.append("different transmissions")
    if differences:
        raise DataError(
            f"the recording is of robot {recorded.name!r}, the configuration describes {robot.name!r} "
            f"(recording / configuration: {'; '.join(differences)})"
        )


def _check_counters(recording: Recording) -> None:
    if recording.missing or recording.counters.get("writer.files", 1) > 1:
        # The last file of several has the counters of the whole capture.
        return
    for name, stream in recording.streams.items():
        counted = recording.counters.get(f"{name}.rows")
        if counted is not None and counted != stream.sync.size:
            raise DataError(f"the recording holds {stream.sync.size} samples of {name!r}, its counter is {counted}")


def _finite(stream: Stream, name: str, robot: RobotConfig) -> Array:
    """Return the field in SI, on its own side, so that an error can name the joint."""
    values = stream.si(name)
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        row, joint = bad[0]
        raise DataError(f"{name} of {robot.joints[joint].name} is not a number at sample {row} ({len(bad)} in all)")
    return values


def _check_missing(present: int, first: int, last: int, dt: float) -> None:
    expected = last - first + 1
    if expected - present > MAX_MISSING_SHARE * expected:
        raise DataError(
            f"{expected - present} of {expected} samples ({100 * (1 - present / expected):.1f} %) of the experiment "
            f"from SYNC {first} to {last} ({expected * dt:.2f} s) are missing; "
            f"at most {100 * MAX_MISSING_SHARE:.0f} % may be: mend the cause, which the import or the capture names, "
            "and record again"
        )


def _demand_stream(recording: Recording) -> Stream | None:
    """Stream with the reference, the samples themselves first; ``None`` if there is none."""
    if recording.samples.named("demand") is not None:
        return recording.samples
    return next((s for s in recording.streams.values() if s.named("demand") is not None and s.sync.size > 1), None)


def _reference(stream: Stream, samples: Stream, robot: RobotConfig) -> Array:
    """Reference (N, n) at the samples."""
    knots = joint_positions(stream, "demand", robot)
    if stream is samples:
        return knots
    _, low, high, share = between_set_points(stream.sync, stream.every, samples.sync)
    q_ref: Array = knots[low] + share * (knots[high] - knots[low])
    return q_ref


def _has_reference(stream: Stream, sync: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask (N,) of samples with a reference, found piece by piece: the numbers of all knots would fill the memory."""
    if stream.sync is sync:
        return np.ones(sync.size, dtype=bool)
    pieces = np.array_split(sync, 1 + sync.size // PIECE)
    return np.concatenate([between_set_points(stream.sync, stream.every, part)[0] for part in pieces])


def _signal_notes(experiments: Sequence[Experiment], robot: RobotConfig) -> list[str]:
    notes: list[str] = []
    unmeasured: list[str] = []
    ranges, torques, count = [], [], 0
    saturation = [joint.drive.saturation for joint in robot.joints]
    gain = np.array([joint.drive.gain for joint in robot.joints])
    limit = np.array([np.inf if s is None or g == 0.0 else 0.999 * s for s, g in zip(saturation, gain, strict=True)])
    saturated = np.zeros(robot.n)
    for e in experiments:
        ranges.append((e.q.min(axis=0), e.q.max(axis=0)))
        torques.append((e.tau.min(axis=0), e.tau.max(axis=0)))
        motor = np.linalg.solve(robot.transmission_matrix.T, e.tau.T).T
        saturated += np.sum(np.abs(motor / np.where(gain == 0.0, 1.0, gain)) >= limit, axis=0)
        count += e.q.shape[0]
    for j, joint in enumerate(robot.joints):
        low, high = joint.limits.position
        seen = (min(float(q[j]) for q, _ in ranges), max(float(q[j]) for _, q in ranges))
        if seen[0] < low or seen[1] > high:
            unit = "rad" if joint.type == "revolute" else "m"
            notes.append(
                f"{joint.name} was recorded over [{seen[0]:.3g}, {seen[1]:.3g}] {unit}, {OUTSIDE} "
                f"[{low:.3g}, {high:.3g}]: wrong unit, order of joints, or limits?"
            )
        largest = max(max(abs(float(low[j])), abs(float(high[j]))) for low, high in torques)
        if largest < NOTHING and seen[1] - seen[0] >= IdentificationCriteria.rest_limit_share * _usual_range(joint):
            unmeasured.append(joint.name)
        if max(float(tau[j]) for _, tau in torques) == min(float(tau[j]) for tau, _ in torques):
            notes.append(f"{joint.name}: the torque never changes; is its drive reporting?")
    if unmeasured:
        raise DataError(
            f"the torque of {', '.join(unmeasured)} is 0 in every row although the joint moves: probably not measured; "
            "check the mapping of the torque where it was recorded"
        )
    for joint, share in zip(robot.joints, saturated / count, strict=True):
        if share > 0.01:
            notes.append(f"{joint.name}: its drive is saturated in {100 * share:.0f} % of the samples")
    return notes


def _usual_range(joint: Joint) -> float:
    """Width of the position limits of a joint, rad or m; two turns or one metre if it has none."""
    width = joint.limits.position[1] - joint.limits.position[0]
    if np.isfinite(width):
        return width
    return ENDLESS[1] - ENDLESS[0] if joint.type == "revolute" else 1.0


def rest_notes(experiments: Sequence[Experiment], robot: RobotConfig) -> list[str]:
    """Remarks on joints that do not move; an identification has them in its verdict."""
    q = np.concatenate([e.q for e in experiments])
    return [
        f"{joint.name} does not move: its own parameters cannot be determined from this recording"
        for joint, width in zip(robot.joints, np.ptp(q, axis=0), strict=True)
        if width < IdentificationCriteria.rest_limit_share * _usual_range(joint)
    ]


def _rate_notes(recording: Recording) -> list[str]:
    """Notes on a SYNC rate that differs from the nominal one by the receive times."""
    samples, nominal = recording.samples, recording.sample_rate_hz
    elapsed = float(samples.t_ns[-1] - samples.t_ns[0]) * 1e-9
    if elapsed <= 0:
        return []
    span = float(samples.sync[-1] - samples.sync[0]) / nominal
    skipped = recording.counters.get("sync_skipped_periods", 0) / nominal
    held_up = min(max(elapsed - span, 0.0), skipped)
    notes = []
    if abs(span / (elapsed - held_up) - 1.0) > RATE_TOLERANCE:
        notes.append(
            f"received at {span * nominal / elapsed:.1f} samples/s, configured are {nominal:.1f}: "
            "SYNC or the receiving clock is off"
        )
    session = recording.session
    virtual = session is not None and all(bus.bitrate is None for bus in session.all_buses)
    if held_up > RATE_TOLERANCE * span and not virtual:
        notes.append(
            f"SYNC stood still for {held_up:.2f} s in all: the capturing machine was too busy, "
            "and samples around these times are not evenly spaced"
        )
    return notes
