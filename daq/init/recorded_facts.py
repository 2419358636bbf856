"""Facts that a recording tells of an arm: sampling rate, units, kind of effort, and the limits that it reached."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.daq.interchange.clocks import UNITS, JitterError, in_seconds
from armident.daq.interchange.import_options import FLAGS, given
from armident.daq.interchange.importing import import_recording, read_rows
from armident.daq.interchange.resampling import usual_rate
from armident.daq.interchange.stated_units import in_si, suspected
from armident.daq.interchange.table_rows import EFFORTS, TableRows
from armident.daq.recording import Recording, is_recording, read_recording

SMOOTHED_S = 0.1
"""Window of the local cubics that give velocity and acceleration, s: motions of arms are below 5 Hz."""

LARGEST_SHARE = 0.999
"""Quantile that counts as the largest velocity or acceleration: the rest may be noise."""

REST_SHARE = 0.01
"""Share of the widest range of motion up to which a joint is at rest, as in `armident.identify`."""


@dataclass(frozen=True)
class RecordedFacts:
    """Facts of a recording, in SI units and the unit of the effort.

    ``position`` (n, 2): lowest and highest; ``velocity``, ``acceleration``, ``effort`` (n,): largest magnitudes.
    ``options``: those of `armident import` for this file, such as ``{"--time-unit": "ms"}``. ``notes``: assumptions.
    """

    path: Path
    rate_hz: float
    duration_s: float
    signal: str
    has_demand: bool
    position: Array
    velocity: Array
    acceleration: Array
    effort: Array
    options: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def examine(path: Path, robot: RobotConfig, stated: Mapping[str, Any]) -> RecordedFacts:
    """Facts of a recording of a robot, with options that correct units and jitter; ``stated``: options of the user."""
    if is_recording(path):
        return _facts(path, read_recording(path), robot, {})
    options: dict[str, Any] = dict(given(stated))
    source, rows = read_rows(path, robot, **given(options, _OF_ROWS))
    if not options.get("units"):
        units = suspected(rows, robot)
        # Positions of LeRobot may be shares of a range: the import names both units.
        options["units"] = {name: unit for name, unit in units.items() if not (source.lerobot and name == "position")}
    if not options.get("time_unit") and rows.times is not None:
        options["time_unit"] = _time_unit(in_si(rows, robot, options["units"]), robot, rows.time_unit)
    with _quiet():
        try:
            recording = import_recording(path, robot, **given(options))
        except JitterError:
            if rows.times is None or "rate_hz" in options:
                raise
            times = rows.times[np.append(True, np.diff(rows.times) > 0)]
            rate = usual_rate(times) / UNITS[options.get("time_unit") or rows.time_unit or "s"]
            options["resample_hz"] = float(f"{rate:.2g}")
            recording = import_recording(path, robot, **given(options))
    return _facts(path, recording, robot, given(options))


_OF_ROWS = ("effort", "names", "topic", "joints", "by_position")
"""Options that choose the columns of a table."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep warnings of the import for the import itself."""
    log = logging.getLogger("armident.daq.interchange.importing")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


def _time_unit(rows: TableRows, robot: RobotConfig, named: str) -> str | None:
    """Unit of the times if it is not the one of their name; seconds are that of a column without a unit."""
    assert rows.times is not None
    try:
        in_seconds(rows.times, rows.values["position"], robot, named=named)
    except DataError:
        for unit, seconds in UNITS.items():
            try:
                in_seconds(rows.times * seconds, rows.values["position"], robot)
            except DataError:
                continue
            return unit
    return None


def _facts(path: Path, recording: Recording, robot: RobotConfig, options: Mapping[str, Any]) -> RecordedFacts:
    samples = recording.samples
    signal = next((name for name in EFFORTS if samples.named(name) is not None), None)
    position = samples.named("position")
    if signal is None or position is None:
        raise DataError(f"{path}: has no position, or no torque, current or voltage")
    q = samples.si(position)
    if samples.fields[position].side == "motor":
        q = np.asarray(np.linalg.solve(recording.robot.transmission_matrix, q.T).T, dtype=np.float64)
    velocity, acceleration = _largest_derivatives(q, samples.sync, recording.sample_rate_hz)
    effort = np.abs(samples.si(str(samples.named(signal)))).max(axis=0)
    notes = tuple(note for note in recording.metadata.get("source_remarks", "").split("; ") if note)
    return RecordedFacts(
        path,
        recording.sample_rate_hz,
        float(samples.sync[-1] - samples.sync[0]) / recording.sample_rate_hz,
        signal,
        any(stream.named("demand") is not None for stream in recording.streams.values()),
        np.stack([q.min(axis=0), q.max(axis=0)], axis=1),
        velocity,
        acceleration,
        effort,
        _as_options(options),
        notes,
    )


def _largest_derivatives(q: Array, sync: NDArray[np.int64], rate_hz: float) -> tuple[Array, Array]:
    """Largest velocity and acceleration (n,) by local cubics, in the pieces between gaps; zero if all are too short."""
    from scipy.signal import savgol_filter

    window = max(5, round(SMOOTHED_S * rate_hz) | 1)
    pieces = [piece for piece in np.split(q, np.flatnonzero(np.diff(sync) > 1) + 1) if len(piece) > window]

    def largest(order: int) -> Array:
        found = [np.zeros((1, q.shape[1]))]
        for piece in pieces:
            values = savgol_filter(piece, window, 3, deriv=order, delta=1.0 / rate_hz, axis=0, mode="interp")
            found.append(np.abs(values[window // 2 : -(window // 2)]))
        return np.asarray(np.quantile(np.concatenate(found), LARGEST_SHARE, axis=0), dtype=np.float64)

    return largest(1), largest(2)


def _as_options(options: Mapping[str, Any]) -> dict[str, str]:
    """Options of the command line; a switch has an empty value."""
    made: dict[str, str] = {}
    for key, value in options.items():
        if isinstance(value, Mapping):
            made[FLAGS[key]] = ",".join(f"{name}={one}" for name, one in value.items())
        elif isinstance(value, bool):
            made[FLAGS[key]] = ""
        elif isinstance(value, list | tuple):
            made[FLAGS[key]] = ",".join(value)
        else:
            made[FLAGS[key]] = f"{value:g}" if isinstance(value, float) else str(value)
    return made


def moved(facts: RecordedFacts, robot: RobotConfig) -> NDArray[np.bool_]:
    """Mask (n,) of the joints that moved: over 1 % of the widest range of joints of their type."""
    ranges = facts.position[:, 1] - facts.position[:, 0]
    revolute = np.array([joint.type == "revolute" for joint in robot.joints])
    widest = np.array([ranges[revolute == one].max() for one in revolute])
    return np.asarray((ranges > REST_SHARE * widest) & (ranges > 0.0), dtype=np.bool_)
